"""Before and after: what is measured, and how it is told."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge.measure.comparison import Comparison, SceneCosts, Storage, break_even, compare
from gsmerge.measure.comparison_page import comparison_document, comparison_markdown
from gsmerge.measure.evaluate import EvaluateOptions
from gsmerge.measure.speed import Speed, measure_speeds, overdraw, resized
from gsmerge.render import plan_view, prepare
from gsmerge.render.weights import view_weights
from gsmerge.report import to_json
from gsmerge.types import Scene

PLAIN = EvaluateOptions(lpips=())


def storage(name: str, count: int, each: int = 68) -> Storage:
    return Storage(f"{name}.ply", count, 100 + each * count, {"means": 12 * count, "rest": (each - 12) * count})


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3))


@pytest.fixture(scope="module")
def actual(scene: Scene) -> Comparison:
    half = scene.gaussians[::2]
    sizes = {"input": storage("input", len(scene.gaussians)), "a|b<i>": storage("half", len(half), 34)}
    return compare(scene, {"a|b<i>": half}, sizes, None, PLAIN, merge_seconds={"a|b<i>": 2.0})


def test_sizes_keep_the_view() -> None:
    cameras = scenes.arc(2, 48, 36)
    large = resized(cameras, 96)
    assert (large.width, large.height) == (96, 72)
    assert np.allclose(large.Ks[:, :2], 2 * cameras.Ks[:, :2])
    assert np.allclose(large.Ks[:, 2], cameras.Ks[:, 2])
    odd = resized(scenes.arc(1, 48, 36), 7)
    assert (odd.width, odd.height) == (7, 5)
    assert (resized(scenes.arc(1, 48, 2), 3).height) == 1


def test_every_scene_is_drawn_at_every_size(scene: Scene) -> None:
    actual = measure_speeds({"a": scene.gaussians, "b": scene.gaussians[:10]}, scene.cameras, (48, 96), 0.01, threads=1)
    cpu = [speed for speed in actual["a"] if speed.device == "cpu"]
    assert [(s.width, s.height, s.threads) for s in cpu] == [(48, 36, 1), (96, 72, 1)]
    assert all(speed.seconds > 0 for speeds in actual.values() for speed in speeds)


def test_overdraw_counts_what_is_blended(scene: Scene) -> None:
    one = scenes.arc(1)
    plan = plan_view(
        prepare(scene.gaussians), one.viewmats[0].astype(np.float64), one.Ks[0].astype(np.float64), 48, 36, near=0.01
    )
    assert overdraw(scene.gaussians, one, 0.01) == len(view_weights(plan).lanes) / (48 * 36)
    assert overdraw(scene.gaussians[:0], one, 0.01) == 0
    assert 1 < overdraw(scene.gaussians[::4], one, 0.01) < overdraw(scene.gaussians, one, 0.01)


def test_break_even() -> None:
    assert break_even(10.0, 0.3, 0.1) == pytest.approx(50)
    assert break_even(10.0, 0.1, 0.1) is None
    assert break_even(0.0, 0.3, 0.1) == 0


def test_factors_multiply_to_the_saving(actual: Comparison) -> None:
    after = comparison_document(actual)["after"][0]
    factors = after["factors"]
    assert factors["count"] == pytest.approx(2)
    assert factors["bytes_per_gaussian"] == pytest.approx(2)
    assert factors["bytes"] == pytest.approx(4, rel=0.01)


def test_break_even_is_that_of_the_measured_times(actual: Comparison) -> None:
    document = comparison_document(actual)
    for before, after in zip(document["before"]["speeds"], document["after"][0]["speeds"], strict=True):
        saved = before["seconds"] - after["seconds"]
        if after["break_even_frames"] is None:
            assert saved <= 1e-5
        elif saved > 1e-4:  # of nearly equal times the rounding decides
            assert after["break_even_frames"] == pytest.approx(2.0 / saved, rel=0.03)


def test_documents(actual: Comparison) -> None:
    document = comparison_document(actual, ["first"])
    assert json.loads(to_json(document))["schema_version"] == 1
    assert document["notes"][0] == "first"
    assert len(document["before"]["speeds"]) >= 2
    markdown = comparison_markdown(document)
    assert all(f"## {title}" in markdown for title in ("Storage", "Rendering", "Overdraw"))
    tables = [block for block in markdown.split("\n\n") if block.startswith("|")]
    for table in tables:
        widths = {len(re.findall(r"(?<!\\)\|", line)) for line in table.splitlines()}
        assert len(widths) == 1, table


def test_without_merge_seconds_nothing_is_earned_back(scene: Scene) -> None:
    side = SceneCosts("input", storage("input", 10), (Speed("cpu", 4, 3, 1, 0.2),), 1.0, None)
    after = replace(side, name="b", speeds=(Speed("cpu", 4, 3, 1, 0.1),))
    quality = compare(scene, {}, {"input": storage("input", 1)}, None, PLAIN, long_sides=(8,)).quality
    document = comparison_document(Comparison(side, (after,), quality))
    assert document["after"][0]["speeds"][0]["break_even_frames"] is None
    assert document["after"][0]["speeds"][0]["speedup"] == pytest.approx(2)


@pytest.mark.parametrize("sides", [(), (0,)])
def test_bad_sizes(sides: tuple[int, ...], scene: Scene) -> None:
    with pytest.raises(ValueError, match="long_sides"):
        compare(scene, {}, {"input": storage("input", 1)}, None, PLAIN, long_sides=sides)
