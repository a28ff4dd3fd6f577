"""Scenes unlike captures, and views of one flat colour, get no score."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
import unaligned_scenes
from messages import noted

from gsmerge import Gaussians, Scene, compact
from gsmerge.method.facts.scene_size import BRIGHT_COLOR, FEWEST_TESTED, LARGE_SCALE, unlike_captures

FIT = {"superpixels": 50, "fit_steps": 5, "checkpoint": "none", "poses": "fixed"}


@pytest.fixture(scope="module")
def room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24))


def sized(gaussians: Gaussians, share: float) -> Gaussians:
    """Make all Gaussians of one size: a share of the diagonal of the box that holds most of them."""
    low, high = np.percentile(gaussians.means, (1, 99), axis=0)
    return replace(gaussians, scales=np.full_like(gaussians.scales, share * np.linalg.norm(high - low)))


@pytest.mark.parametrize(("share", "words"), [(1e-8, None), (0.9 * LARGE_SCALE, None), (1.1 * LARGE_SCALE, "at least")])
def test_sizes_beyond_a_bound_are_unlike_captures(share: float, words: str | None, room: Scene) -> None:
    odd = unlike_captures(sized(room.gaussians, share))
    assert (odd is None) == (words is None)
    assert words is None or (f"{words} {share:.2g} times as large as the scene" in odd and "nothing is scored" in odd)


@pytest.mark.parametrize(
    ("value", "is_odd"), [(0.9 * BRIGHT_COLOR, False), (1.1 * BRIGHT_COLOR, True), (-1.1 * BRIGHT_COLOR, True)]
)
def test_colours_beyond_a_bound_are_unlike_captures(value: float, is_odd: bool, room: Scene) -> None:
    colors = value * (1 + 0.01 * np.random.default_rng(0).random(room.gaussians.sh0.shape, np.float32))
    odd = unlike_captures(replace(room.gaussians, sh0=colors))
    assert (odd is not None) == is_odd
    assert odd is None or "base colours have coefficients beyond 11" in odd


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [("sh0", 0.3, "one flat colour"), ("opacities", 0.001, "opacities")],
    ids=["flat", "faint"],
)
def test_gaussians_of_one_colour_or_all_faint_are_unlike_captures(
    name: str, value: float, words: str, room: Scene
) -> None:
    odd = replace(room.gaussians, **{name: np.full_like(getattr(room.gaussians, name), value)})
    assert noted([unlike_captures(odd) or ""], words)


def test_a_third_or_a_handful_of_odd_gaussians_is_like_captures(room: Scene) -> None:
    scales = room.gaussians.scales.copy()
    scales[::3] *= 1e6
    assert unlike_captures(replace(room.gaussians, scales=scales)) is None
    assert unlike_captures(room.gaussians) is None
    large = sized(room.gaussians, 10)
    assert unlike_captures(large[: FEWEST_TESTED - 1]) is None
    assert unlike_captures(large[:0]) is None


def test_scenes_unlike_captures_have_no_score(room: Scene) -> None:
    bright = replace(room.gaussians, sh0=np.full_like(room.gaussians.sh0, 40))
    for scene in (replace(room, gaussians=bright), replace(room, gaussians=sized(room.gaussians, 0.5))):
        report = compact(scene, **FIT).report
        odd = unlike_captures(scene.gaussians)
        assert (report.psnr_before, report.psnr_after, report.covered, report.new_views) == (None, None, None, None)
        assert report.worse == odd
        assert report.notes.count(odd) == 1


def test_views_of_one_colour_have_no_score() -> None:
    flat = scenes.make_scene([scenes.plane(3.0, scenes.flat(0.5, 0.5, 0.5))], scenes.arc(3, 32, 24), opacity=(1, 1))
    opaque = replace(flat.gaussians, opacities=np.full_like(flat.gaussians.opacities, 0.999))
    flat = replace(flat, gaussians=replace(opaque, scales=2 * opaque.scales), images=None)
    scene = unaligned_scenes.without_order(flat)
    report = compact(scene, **FIT).report
    assert "one flat colour" in report.worse
    assert (report.psnr_before, report.psnr_after) == (None, None)
    assert "fidelity" not in report.choices
    assert noted(report.notes, "one flat colour")
