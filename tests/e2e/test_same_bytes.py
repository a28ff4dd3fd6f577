"""The same bytes from every processor, by the libraries' own ways to use older instructions, and any number of threads.

A processor is stood for by the target of the native library and by what NumPy, its BLAS, OpenCV, its IPP and torch are
told not to use. Each is one process that compacts all scenes with all settings.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsmerge.kernels.library import _able_targets

TARGETS = [target.name for target in _able_targets()]
SETTINGS = {
    "default": (),
    "no fit": ("--fit", "none"),
    "full fit": ("--fit", "full", "--set", "fit_steps=40", "--k", "2", "--budget", "5%"),
}
# Rows of the results of the scene that `write_exact_scene` writes, on every machine. After a change of results on
# purpose, the failing test prints the new ones.
EXACT = {
    "default": "9ddcb3b2422d04b3",
    "no fit": "2de923162af38155",
    "full fit": "ce6ff78902e6bf8d",
}
COMPACT = """
import json, sys
from gsmerge.cli import main
calls = json.loads(sys.argv[1])
sys.exit(max(main(call) for call in calls))
"""


def plain() -> dict[str, str]:
    """Settings of the libraries that take all that only some processors have from them."""
    core = np._core if hasattr(np, "_core") else np.core
    return {
        "NPY_DISABLE_CPU_FEATURES": " ".join(core._multiarray_umath.__cpu_dispatch__),
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


def hash_rows(ply: Path) -> str:
    """Hash what follows the header, which names the version."""
    return hashlib.sha256(ply.read_bytes().split(b"end_header\n", 1)[1]).hexdigest()[:16]


def write_exact_scene(folder: Path, views: int = 4, width: int = 64, height: int = 48) -> Path:
    """Write a wall with steps before it, of whole numbers over powers of two: nothing is rounded anywhere."""
    y, x = np.mgrid[:height, :width]
    depths = (256 + 2 * ((x // 8 + y // 6) % 5) - 64 * ((x - 20) ** 2 + (y - 24) ** 2 < 144)) / 128
    frames, rows = [], []
    (folder / "images").mkdir(parents=True)
    for view in range(views):
        shift = view / 8 - 3 / 16
        means = np.stack([(x + 0.5 - 32) / 64 * depths + shift, (y + 0.5 - 24) / 64 * depths, depths], -1)
        u, v = np.floor(32 * means[..., :2] + 64).astype(int).transpose(2, 0, 1)  # a texture of places in the world
        colors = np.stack([abs(9 * u % 256 - 128), abs(7 * v % 256 - 128), 2 * abs((3 * u + 5 * v) % 128 - 64)], -1)
        one = np.zeros((height, width, 14), "<f4")
        one[..., :3] = means
        one[..., 3:6] = (colors - 128) / 64
        one[..., 6] = 1 + (x + y) % 4
        one[..., 7:10] = -4.25, -4.5, -6
        one[..., 10] = 1
        rows.append(one.reshape(-1, 14))
        (folder / "images" / f"{view}.png").write_bytes(cv2.imencode(".png", colors[..., ::-1].astype(np.uint8))[1])
        pose = [[1, 0, 0, shift], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]
        frames.append({"file_path": f"images/{view}.png", "transform_matrix": pose})
    colors, turns = [f"f_dc_{i}" for i in range(3)], [f"rot_{i}" for i in range(4)]
    names = ["x", "y", "z", *colors, "opacity", *(f"scale_{i}" for i in range(3)), *turns]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {views * height * width}"]
    lines += [f"property float {name}" for name in names]
    (folder / "scene.ply").write_bytes("\n".join([*lines, "end_header", ""]).encode() + np.concatenate(rows).tobytes())
    lens = {"w": width, "h": height, "fl_x": 64, "fl_y": 64, "cx": 32, "cy": 24}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}), encoding="utf-8")
    return folder


def take_rows(ply: Path, taken: int) -> None:
    """Keep some rows of a scene in a random order, so that no pixel is known for any."""
    head, rows = ply.read_bytes().split(b"end_header\n", 1)
    count = next(line.split()[-1] for line in head.splitlines() if line.startswith(b"element vertex"))
    table = np.frombuffer(rows, np.uint8).reshape(int(count), -1)
    some = table[np.random.default_rng(0).permutation(len(table))[:taken]]
    ply.write_bytes(head.replace(count, str(taken).encode()) + b"end_header\n" + some.tobytes())


@pytest.fixture(scope="module")
def scenes(make_scene: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Three folders: of one Gaussian per pixel, of Gaussians without an order, and of exact numbers."""
    folder = tmp_path_factory.mktemp("processors")
    aligned = make_scene(folder / "aligned", num_views=4, width=96, height=64)
    unaligned = make_scene(folder / "unaligned", num_views=4, width=96, height=64, seed=5)
    take_rows(unaligned / "scene.ply", 8000)
    return {"aligned": aligned, "unaligned": unaligned, "exact": write_exact_scene(folder / "exact")}


@pytest.fixture(scope="module")
def here(scenes: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The results of this machine as it is, with two threads."""
    return compact(scenes, tmp_path_factory.mktemp("here") / "out", 2, {})


@pytest.mark.parametrize("target", TARGETS)
def test_every_processor_gives_the_same_bytes(
    target: str, here: dict[str, str], scenes: dict[str, Path], tmp_path: Path
) -> None:
    assert compact(scenes, tmp_path / "out", 1, plain() | {"GSMERGE_TARGET": target}) == here


def test_every_machine_gives_the_same_bytes(here: dict[str, str]) -> None:
    assert {setting: here[f"exact, {setting}"] for setting in SETTINGS} == EXACT
