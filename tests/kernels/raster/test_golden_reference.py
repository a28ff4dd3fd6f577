"""The renderer against float64 renders made with gsplat's own projection; they are large and lie outside the project.

Opt-in: the folder ``golden`` with ``scenes.py`` and the renders is looked for in ``$GSMERGE_DATA`` and in
``../shared`` beside the repository.
"""

from __future__ import annotations

import importlib.util
import os
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from gsmerge import Cameras, Gaussians
from gsmerge.method.raster import render
from gsmerge.method.raster.metrics import psnr

SHARED = Path(os.environ.get("GSMERGE_DATA", Path(__file__).resolve().parents[4] / "shared"))
GOLDEN = SHARED / "golden"

pytestmark = pytest.mark.skipif(not (GOLDEN / "scenes.py").exists(), reason="needs the golden renders")


def load_generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("golden_scenes", GOLDEN / "scenes.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def scene(name: str) -> dict[str, np.ndarray]:
    generator = load_generator()
    return generator.make(*generator.SPEC[name])


@pytest.mark.parametrize(
    ("name", "degree", "file"),
    [
        ("S1", 0, "S1_sh0_rgb"),
        ("S1", 3, "S1_sh3_rgb"),
        ("S1", 3, "S1_sh3_antialiased_rgb"),
        ("S3", 0, "S3_sh0_rgb"),
        ("S3", 3, "S3_sh3_rgb"),
    ],
)
def test_renders_match_those_of_gsplats_projection_in_float64(name: str, degree: int, file: str) -> None:
    data = scene(name)
    means, quats, scales, opacities, sh = (data[key] for key in ("means", "quats", "scales", "opacities", "sh"))
    gaussians = Gaussians(means, quats, scales, opacities, sh[:, :1], sh[:, 1 : (degree + 1) ** 2])
    viewmats, Ks = (data[key][None].astype(np.float64) for key in ("viewmat", "K"))
    cameras = Cameras(viewmats, Ks, int(data["width"]), int(data["height"]))
    rendering = render(gaussians, cameras, antialiased="antialiased" in file)
    assert psnr(rendering.images[0], np.load(GOLDEN / f"{file}.npy")) >= 85
    if file.endswith("sh3_rgb"):
        assert psnr(rendering.alphas[0], np.load(GOLDEN / f"{name}_sh3_alpha.npy")[..., None]) >= 85
