"""Errors of levels of detail: what a leaf's coarser level loses in pictures, and what no picture shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge.io.formats.streamed import Leaf
from gsmerge.measure.level_errors import LevelErrors, coverage, level_errors
from gsmerge.types import Cameras, Gaussians

WIDTH, HEIGHT = 64, 48
SIDES = {"left": (-1.0, 0.0), "right": (0.0, 1.0)}  # x at which the picture at depth 1 spans -.5 to .5


def wall(depth: float, left: float, right: float) -> Gaussians:
    """An opaque wall of coloured Gaussians between two x."""
    x, y = np.meshgrid(np.arange(left, right, 0.05) + 0.025, np.arange(-0.6, 0.6, 0.05) + 0.025)
    n, rng = x.size, np.random.default_rng(0)
    depths = depth + rng.uniform(-0.01, 0.01, n)  # where two are as far, the order of the rows decides
    return Gaussians(
        np.stack([x.ravel(), y.ravel(), depths], 1).astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (n, 1)), np.full((n, 3), 0.03, np.float32), np.full(n, 0.95, np.float32),
        rng.normal(size=(n, 1, 3)).astype(np.float32), np.zeros((n, 0, 3), np.float32),
    )  # fmt: skip


def cameras(views: int = 1) -> Cameras:
    return Cameras(np.tile(np.eye(4), (views, 1, 1)), scenes.intrinsics(views, WIDTH, HEIGHT), WIDTH, HEIGHT)


def sides(levels: list[Gaussians]) -> list[Leaf]:
    """One leaf on the left and one on the right."""
    leaves = []
    for left, right in SIDES.values():
        rows = [np.flatnonzero((level.means[:, 0] >= left) & (level.means[:, 0] < right)) for level in levels]
        leaves.append(Leaf({"bound": {"min": [left, -0.6, 0.9], "max": [right, 0.6, 1.1]}}, rows))
    return leaves


def errors_of(levels: list[Gaussians], environment: Gaussians | None = None) -> np.ndarray:
    measure = level_errors(levels, cameras(3), 0.01, environment)
    assert isinstance(measure, LevelErrors)
    return measure(sides(levels))


def thinned(level: Gaussians, left: float, right: float, keep: int) -> Gaussians:
    """Every so many of the Gaussians between two x, and all others."""
    inside = (level.means[:, 0] >= left) & (level.means[:, 0] < right)
    return level[~inside | (np.arange(len(level)) % keep == 0)]


def test_only_what_changes_has_an_error() -> None:
    finest = wall(1.0, -1, 1)
    coarser = [thinned(finest, *SIDES["right"], keep) for keep in (2, 8)]
    (same, changed) = errors_of([finest, *coarser])
    assert same == pytest.approx(0, abs=1e-9)
    assert changed[0] == 0
    assert 0.01 < changed[1] < changed[2]


def test_errors_never_fall() -> None:
    finest = wall(1.0, -1, 1)
    back = [finest, thinned(finest, *SIDES["right"], 8), finest]
    assert (np.diff(errors_of(back), axis=1) >= 0).all()


def test_what_is_hidden_has_no_error() -> None:
    finest = wall(1.0, -1, 1)
    levels = [finest, thinned(finest, *SIDES["right"], 8)]
    front = wall(0.8, -1, 1)
    hidden = replace(front, scales=2 * front.scales, opacities=np.full(len(front), 0.99, np.float32))
    assert errors_of(levels, hidden).max() < 0.01 * errors_of(levels).max()


def test_a_level_without_gaussians_of_a_leaf() -> None:
    """The finest one that a leaf has is what the others are compared with."""
    finest = wall(1.0, -1, 1)
    left = finest[finest.means[:, 0] < 0]
    assert errors_of([left, finest, finest])[1] == pytest.approx(0, abs=1e-9)
    assert np.isfinite(errors_of([finest, left])).all()


def test_nothing_to_choose_or_to_look_from() -> None:
    chain = [wall(1.0, -1, 1)] * 2
    assert level_errors(chain[:1], cameras(), 0.01) is None
    assert level_errors(chain, cameras()[np.arange(0)], 0.01) is None


def test_coverage() -> None:
    """A box of radius 1, seen from inside, and from 3 away with half the slope of the usual field of view."""
    half = 1 / np.sqrt(3)
    away = 3 + half
    boxes = [Leaf({"bound": {"min": [x - half, -half, -half], "max": [x + half, half, half]}}, []) for x in (0, away)]
    camera = replace(cameras(), Ks=np.array([[[10.0, 0, 5], [0, 10, 5], [0, 0, 1]]]), width=10, height=10)
    slope = 0.5 / (np.sqrt(2) - 1)
    assert coverage(boxes, camera) == pytest.approx([1, 1 / (1 + 3 * slope) ** 2])
