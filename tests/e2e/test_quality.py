"""Floors in dB on photos that the scene was not made from, at fixed counts.

Measured when written, seeds 0 to 2: input 20.0 to 20.3 dB; 256 superpixels per view 24.6 to 25.0; 64 per view 23.4
to 23.7; plain merging without photos 20.2. The floors are half a dB below the lowest.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import gsmerge

Measure = Callable[[Path, Path], float]
NUM_INPUT = 5 * 64 * 96


@pytest.mark.parametrize(
    ("settings", "most", "floor"),
    [
        ({"superpixels": 256}, 0.044, 24.1),
        ({"superpixels": 256, "k": 2}, 0.084, 24.3),
        ({"superpixels": 64}, 0.0105, 22.9),
        ({"superpixels": 256, "robust": False, "fit": "none"}, 0.044, 19.7),
    ],
    ids=["K1", "K2", "1%", "plain"],
)
def test_floor(
    settings: dict[str, Any], most: float, floor: float, made_scene: Path, tmp_path: Path, target_psnr: Measure
) -> None:
    result = gsmerge.compact(gsmerge.read_scene(made_scene), **settings)
    assert len(result.gaussians) <= most * NUM_INPUT
    out = tmp_path / "small.ply"
    gsmerge.write_ply(out, result.gaussians)
    assert target_psnr(made_scene / "targets", out) >= floor


def test_photos_help(made_scene: Path, tmp_path: Path, target_psnr: Measure) -> None:
    """With the photos the compact scene beats its input by far on views that nobody has seen."""
    out = tmp_path / "small.ply"
    gsmerge.write_ply(out, gsmerge.compact(gsmerge.read_scene(made_scene), superpixels=256).gaussians)
    before, after = (target_psnr(made_scene / "targets", ply) for ply in (made_scene / "scene.ply", out))
    assert after > before + 3.5
