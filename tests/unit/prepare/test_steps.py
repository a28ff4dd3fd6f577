"""Preparing a scene is a table of steps, each of which says what it did to photos, cameras and Gaussians."""

from __future__ import annotations

import html
from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import Scene, compact, view
from gsmerge.method.geometry.views import subset
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.prepare.steps import STEPS, select, without


@pytest.fixture(scope="module")
def room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24))


def test_a_sound_scene_is_not_changed(room: Scene) -> None:
    assert prepare(room).changes == ()


def test_each_change_is_told_in_the_order_of_the_steps(room: Scene) -> None:
    twice = subset(room, [0, 0, 1, 2])
    broken = replace(twice.gaussians, opacities=np.where(np.arange(len(twice.gaussians)) == 5, np.nan, 0.9))
    changes = prepare(replace(twice, gaussians=broken)).changes
    assert changes[0] == "1 Gaussian not finite: left out"
    assert prepare(twice).changes[0] == "1 view repeats another in every pixel and counts once"


def test_changes_are_in_the_report(room: Scene) -> None:
    twice = subset(room, [0, 0, 1, 2])
    report = compact(twice, effort="draft", budget=100).report
    assert report.choices["changes"] == ["1 view repeats another in every pixel and counts once"]
    assert "changes" not in compact(room, effort="draft", budget=100).report.choices


def test_changes_are_on_the_page_of_a_result(room: Scene) -> None:
    dark = replace(room, images=0.5 * room.images)
    result = compact(dark, effort="draft", budget=100)
    (change,) = result.report.choices["changes"]
    assert "3 of 3 photos have another tone" in change
    assert f"Changed before merging: {change}." in html.unescape(view(dark, result).text)


def test_steps_are_left_out_by_names_that_there_are() -> None:
    assert len(without("photos", "holes")) == len(STEPS) - 2
    with pytest.raises(ValueError, match="foto"):
        without("foto")


def test_fewer_steps_do_less(room: Scene) -> None:
    bare = replace(room, pixels=None, images=None)
    assert prepare(bare, steps=select("frame")).scene.pixels is None
    assert prepare(bare, steps=select("pixels", "frame")).scene.pixels is not None
    assert [step.name for step in select("photos", "frame")] == ["frame", "photos"]
    assert len(without("holes")) == len(STEPS) - 1
