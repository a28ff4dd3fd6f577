"""The same bytes from every processor, by the libraries' own ways to use older instructions, and any number of threads.

A processor is stood for by the target of the native library and by what NumPy, its BLAS, OpenCV, its IPP and torch are
told not to use. Each is one process that compacts all scenes with all settings.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from exact_results import hash_rows, take_rows

from gsmerge.kernels.library import _able_targets

TARGETS = [target.name for target in _able_targets()]
NEWEST_ALONE = [*TARGETS[-1:], *(pytest.param(name, marks=pytest.mark.slow) for name in TARGETS[:-1])]
SETTINGS = {
    "default": (),
    "no fit": ("--fit", "none"),
    "full fit": ("--fit", "full", "--set", "fit_steps=40", "--k", "2", "--budget", "5%"),
}
# One hash of the script's eight results, on every machine. After a change of results on purpose the failing test prints
# the new one.
SCRIPT = Path(__file__).parents[1] / "helpers" / "exact_results.py"
EXACT = "756a9b8c410ac76a0972fc21b09e1ede"
COMPACT = """
import json, sys
from gsmerge.cli import main
calls = json.loads(sys.argv[1])
sys.exit(max(main(call) for call in calls))
"""


def plain() -> dict[str, str]:
    """Settings of the libraries that take all that only some processors have from them."""
    return {
        "NPY_DISABLE_CPU_FEATURES": " ".join(np._core._multiarray_umath.__cpu_dispatch__),
        "OPENBLAS_CORETYPE": "Sandybridge",
        "OPENCV_CPU_DISABLE": "AVX512-SKX,AVX2,FP16",
        "OPENCV_IPP": "disabled",
        "ATEN_CPU_CAPABILITY": "default",
    }


def compact(scenes: dict[str, Path], out: Path, threads: int, processor: dict[str, str]) -> dict[str, str]:
    """Compact every scene with every setting in one process -> hashes of the rows of the results."""
    out.mkdir()
    results = {f"{scene}, {setting}": out / f"{scene} {setting}.ply" for scene in scenes for setting in SETTINGS}
    calls = [
        ["compact", str(folder), "-o", str(results[f"{scene}, {setting}"]), *options, "--threads", str(threads), "-q"]
        for scene, folder in scenes.items()
        for setting, options in SETTINGS.items()
    ]
    env = {key: value for key, value in os.environ.items() if key not in plain()} | processor
    command = [sys.executable, "-c", COMPACT, json.dumps(calls)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return {name: hash_rows(path) for name, path in results.items()}


@pytest.fixture(scope="module")
def scenes(make_scene: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Two folders: of one Gaussian per pixel, and of Gaussians without an order."""
    folder = tmp_path_factory.mktemp("processors")
    aligned = make_scene(folder / "aligned", num_views=4, width=96, height=64)
    unaligned = make_scene(folder / "unaligned", num_views=4, width=96, height=64, seed=5)
    take_rows(unaligned / "scene.ply", 8000)
    return {"aligned": aligned, "unaligned": unaligned}


@pytest.fixture(scope="module")
def here(scenes: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The results of this machine as it is, with two threads."""
    return compact(scenes, tmp_path_factory.mktemp("here") / "out", 2, {})


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
def test_every_processor_gives_the_same_bytes(
    target: str, here: dict[str, str], scenes: dict[str, Path], tmp_path: Path
) -> None:
    assert compact(scenes, tmp_path / "out", 1, plain() | {"GSMERGE_TARGET": target}) == here


@pytest.mark.parametrize("target", NEWEST_ALONE)
def test_every_machine_gives_the_same_bytes(target: str) -> None:
    env = {key: value for key, value in os.environ.items() if key not in plain()} | plain() | {"GSMERGE_TARGET": target}
    command = [sys.executable, str(SCRIPT)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["all"] == EXACT, done.stdout
