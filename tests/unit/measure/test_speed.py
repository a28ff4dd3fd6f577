"""The costs of drawing a scene: render time, overdraw, frames to break even."""

from __future__ import annotations

import numpy as np
import pytest
import scenes

from gsmerge.measure.speed import measure_costs, overdraw
from gsmerge.raster import make_splats, tile_view
from gsmerge.raster.weights import view_weights
from gsmerge.types import Scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3))


def test_overdraw_counts_what_is_blended(scene: Scene) -> None:
    one = scenes.arc(1)
    tiled = tile_view(
        make_splats(scene.gaussians),
        one.viewmats[0].astype(np.float64),
        one.Ks[0].astype(np.float64),
        48,
        36,
        near=0.01,
    )
    assert overdraw(scene.gaussians, one, 0.01) == len(view_weights(tiled).lanes) / (48 * 36)
    assert overdraw(scene.gaussians[:0], one, 0.01) == 0
    assert 1 < overdraw(scene.gaussians[::4], one, 0.01) < overdraw(scene.gaussians, one, 0.01)


def test_costs_are_compared_with_those_of_the_first(scene: Scene) -> None:
    parts = {"input": scene.gaussians, "half": scene.gaussians[::2], "quarter": scene.gaussians[::4]}
    actual = measure_costs(parts, scene.cameras, (0.5, 1), 0.01, threads=1)
    sizes = [(speed["width"], speed["height"], speed["threads"]) for speed in actual["half"]["speeds"][:2]]
    assert sizes == [(24, 18, 1), (48, 36, 1)]
    assert all(speed["seconds"] > 0 for cost in actual.values() for speed in cost["speeds"])
    for before, after in zip(actual["input"]["speeds"], actual["half"]["speeds"], strict=True):
        assert after["speedup"] == pytest.approx(before["seconds"] / after["seconds"])
