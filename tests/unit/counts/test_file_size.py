"""A budget in bytes is spent on harmonics or on more Gaussians, whichever shows the photos better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scenes

from gsmerge import CompactResult, compact, render
from gsmerge.io.formats.table import PLY


def compact_wall(texture: scenes.Texture, *, shine: float) -> CompactResult:
    """Compact a wall with harmonics of degree 3 into 40 kB; ``shine`` is how much brighter it is from the left."""
    wall = scenes.make_scene([scenes.plane(3.0, texture)], scenes.arc(5, 48, 32), opacity=(0.95, 0.95))
    shN = np.zeros((len(wall.gaussians), 15, 3), np.float32)
    shN[:, 2] = shine
    gaussians = replace(wall.gaussians, shN=shN)
    images = render(gaussians, wall.cameras).images.clip(0, 1)
    return compact(replace(wall, gaussians=gaussians, images=images), budget="40KB", effort="draft")


def test_harmonics_that_show_nothing_make_room_for_gaussians() -> None:
    result = compact_wall(scenes.waves(0), shine=0.0)
    assert result.gaussians.sh_degree == 0
    assert len(result.gaussians) > 2 * 40_000 / PLY.gaussian_bytes[3]
    assert any("harmonics are left out" in note for note in result.report.notes)


def test_harmonics_that_photos_show_stay() -> None:
    result = compact_wall(scenes.flat(0.5, 0.5, 0.5), shine=1.0)
    assert result.gaussians.sh_degree == 3
    assert not any("harmonics are left out" in note for note in result.report.notes)
