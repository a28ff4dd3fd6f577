"""Floors (floors.csv, dB) on photos that the scene was not made from, at fixed counts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import gsmerge

Measure = Callable[[Path, Path], float]
NUM_INPUT = 5 * 64 * 96


@pytest.mark.parametrize(
    ("settings", "most"),
    [
        ({"superpixels": 256}, 0.044),
        ({"superpixels": 256, "k": 2}, 0.084),
        ({"superpixels": 64}, 0.0105),
        ({"superpixels": 256, "robust": False, "fit": "none"}, 0.044),
    ],
    ids=["K1", "K2", "1%", "plain"],
)
def test_floor(
    settings: dict[str, Any],
    most: float,
    made_scene: Path,
    tmp_path: Path,
    target_psnr: Measure,
    floor: Callable[..., None],
) -> None:
    result = gsmerge.compact(gsmerge.read_scene(made_scene), **settings)
    assert len(result.gaussians) <= most * NUM_INPUT
    out = tmp_path / "small.ply"
    gsmerge.write_ply(out, result.gaussians)
    floor(target_psnr(made_scene / "targets", out))


def test_photos_help(made_scene: Path, tmp_path: Path, target_psnr: Measure, floor: Callable[..., None]) -> None:
    """With the photos the compact scene beats its input by far on views that nobody has seen."""
    out = tmp_path / "small.ply"
    gsmerge.write_ply(out, gsmerge.compact(gsmerge.read_scene(made_scene), superpixels=256).gaussians)
    before, after = (target_psnr(made_scene / "targets", ply) for ply in (made_scene / "scene.ply", out))
    floor(after - before)
