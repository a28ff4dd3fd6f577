"""Generated scenes are the same bytes whatever code NumPy, its BLAS and OpenCV choose for the processor."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from targets import runnable_targets

SCENE = """
import hashlib
from gsmerge.research.generate.synthetic_scene import GenerateOptions, make_synthetic_scene
for index in range(2):
    scene = make_synthetic_scene(5, index, GenerateOptions(views=2, width=64, height=48))
    arrays = [*vars(scene.gaussians).values(), scene.cameras.viewmats, scene.targets.viewmats, *scene.images]
    print(*(hashlib.sha256(array.tobytes()).hexdigest() for array in arrays))
"""
OTHERS = {
    "NPY_DISABLE_CPU_FEATURES": "X86_V4",
    "OPENBLAS_CORETYPE": "Haswell",
    "OPENCV_CPU_DISABLE": "AVX512-SKX",
    "OPENCV_IPP": "disabled",
}


@pytest.mark.slow
def test_scenes_do_not_depend_on_the_processor() -> None:
    targets = runnable_targets()
    scenes = {
        subprocess.run([sys.executable, "-c", SCENE], env=env, capture_output=True, text=True, check=True).stdout
        for env in (
            {**os.environ, "GSMERGE_TARGET": targets[-1]},
            {**os.environ, **OTHERS, "GSMERGE_TARGET": targets[0]},
        )
    }
    assert len(scenes) == 1
    assert all(scenes)
