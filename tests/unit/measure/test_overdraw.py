"""Overdraw that can be worked out: walls behind each other, small ones in a corner, sizes of a device's pixels."""

from __future__ import annotations

import numpy as np
import pytest
import scenes

from gsmerge.measure.overdraw import Overdraw, overdraw_pictures
from gsmerge.settings.budget import Device
from gsmerge.types import Cameras, Gaussians

NUM_WALLS = 7


def sheets(depths: np.ndarray, scale: float, place: float = 0.0) -> Gaussians:
    """One flat opaque Gaussian at each depth, to the right of the middle by ``place`` times its depth."""
    n = len(depths)
    return Gaussians(
        np.stack([place * depths, 0 * depths, depths], 1).astype(np.float32), np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        np.tile(np.float32([scale, scale, 0.001]), (n, 1)), np.full(n, 0.99, np.float32),
        np.zeros((n, 1, 3), np.float32), np.zeros((n, 0, 3), np.float32),
    )  # fmt: skip


def cameras(views: int = 2) -> Cameras:
    return Cameras(np.tile(np.eye(4), (views, 1, 1)), scenes.intrinsics(views, 96, 64), 96, 64)


def measure(gaussians: Gaussians, side: int = 96) -> dict[str, Overdraw]:
    return overdraw_pictures(gaussians, cameras(), side, 0.01).measure(gaussians)


def test_walls_behind_each_other_all_count() -> None:
    walls = sheets(np.linspace(1, 2, NUM_WALLS), 100.0)
    assert measure(walls) == {kind: Overdraw(NUM_WALLS, NUM_WALLS) for kind in ("views", "outside")}


def test_crowded_pixels_are_those_of_the_crowd() -> None:
    wall, crowd = sheets(np.array([2.0]), 100.0), sheets(np.linspace(1, 1.1, 50), 0.06)
    views = measure(Gaussians.concat([wall, crowd]))["views"]
    assert views.mean < 10
    assert views.crowded > 40


def test_what_is_small_is_less_on_a_finer_screen() -> None:
    """A Gaussian that fills no pixel is drawn about a pixel wide, on any screen."""
    rng = np.random.default_rng(0)
    dust = sheets(np.full(400, 1.0), 1e-4)
    dust.means[:, :2] = rng.uniform(-0.4, 0.4, (400, 2))
    assert measure(dust, 960)["views"].mean < 0.5 * measure(dust, 96)["views"].mean


def test_what_adds_least_comes_first() -> None:
    front, hidden, faint = (sheets(np.array([depth]), 100.0) for depth in (1.0, 3.0, 0.9))
    faint = Gaussians(**{**vars(faint), "opacities": np.float32([0.05])})
    scene = Gaussians.concat([front, hidden, faint])
    assert overdraw_pictures(scene, cameras(), 96, 0.01).order_by_worth(scene).tolist() == [1, 2, 0]


def test_excess() -> None:
    device = Device(10, overdraw=20, crowded=100)
    assert Overdraw(30, 90).excess(device) == pytest.approx(1.5)
    assert Overdraw(10, 90).excess(device) == pytest.approx(0.9)
    assert Overdraw(1e9, 1e9).excess(Device(10)) == 0
