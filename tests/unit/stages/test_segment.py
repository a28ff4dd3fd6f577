"""The plan tells how many superpixels a scene gets."""

from __future__ import annotations

import pytest
import scenes

from gsmerge import CompactOptions, Scene
from gsmerge.plan import make_plan
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.stages.segment import SuperpixelChoices, segment_scene

SHARE = {"superpixels": "5%"}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24), noise=0.01)


def scene_and_choices(scene: Scene, **settings: object) -> tuple[Scene, SuperpixelChoices]:
    options = CompactOptions().with_settings({"fit": "none"} | settings)
    prepared = prepare(scene, options.prepare)
    return prepared.scene, make_plan(prepared, options).superpixels


def test_a_fit_begins_with_a_share_of_the_number(scene: Scene) -> None:
    whole = segment_scene(*scene_and_choices(scene, **SHARE), None)
    canonical, choices = scene_and_choices(scene, **SHARE, fit="full")
    assert choices.start_share < 1
    segmentation = segment_scene(canonical, choices, None)
    assert segmentation.count == pytest.approx(whole.count, rel=0.02)
    assert len(segmentation.groups) < 1.02 * choices.start_share * segmentation.count


def test_an_exact_number_is_met(scene: Scene) -> None:
    assert segment_scene(*scene_and_choices(scene, **SHARE | {"superpixels": 40}), None).groups.counts == (40, 40, 40)
    assert len(segment_scene(*scene_and_choices(scene, **SHARE), 100).groups) == 100
    assert len(scenes.plain(scene, **SHARE, budget=90)) == 90
