"""The number of views that show a Gaussian is that of compositing pixel by pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import Gaussians
from gsmerge.method.raster import composite, make_splats, tile_view
from gsmerge.method.raster.photos import blank_photos
from gsmerge.method.viewpoints.support import count_views
from gsmerge.types import Cameras


@pytest.fixture(scope="module")
def cameras() -> Cameras:
    return scenes.arc(3, 64, 48)


@pytest.fixture(scope="module")
def room() -> Gaussians:
    made = scenes.make_scene(scenes.room(), scenes.arc(3, 64, 48), noise=0.01).gaussians
    return made[:: max(1, len(made) // 150)]


def test_a_view_counts_for_a_gaussian_where_its_picture_shows_it(room: Gaussians, cameras: Cameras) -> None:
    """A white Gaussian among black ones shows its own weights."""
    half = blank_photos(cameras, 2)
    views = [tile_view(make_splats(room), **half.camera(view)) for view in range(len(half))]
    counts = np.zeros(len(room), int)
    for row in range(len(room)):
        white = np.zeros((len(room), 3), np.float32)
        white[row] = 1
        counts[row] = sum(composite(view, white)[0].max() >= 1 / 255 for view in views)
    assert (counts > 1).any()
    np.testing.assert_array_equal(count_views(room, cameras), counts)


def test_gaussians_behind_all_cameras_count_no_views(room: Gaussians, cameras: Cameras) -> None:
    away = replace(room, means=room.means - 1000 * cameras.viewmats[:, 2, :3].mean(0).astype(np.float32))
    assert not count_views(away, cameras).any()
    assert len(count_views(room[:0], cameras)) == 0
