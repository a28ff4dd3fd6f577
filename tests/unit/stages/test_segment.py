"""How many superpixels a scene gets where they adapt to the pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import CompactOptions, Scene
from gsmerge.budget import count_limits, default_count, largest_count
from gsmerge.compaction.make_plan import make_plan
from gsmerge.facts.prepare import prepare
from gsmerge.facts.scene_size import measure_size
from gsmerge.stages.segment import SuperpixelChoices, segment_scene

ADAPTIVE = {"segmentation": "bass-adaptive", "superpixels": "5%"}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24), noise=0.01)


def scene_and_choices(scene: Scene, **settings: object) -> tuple[Scene, SuperpixelChoices]:
    options = CompactOptions().with_settings({"fit": "none"} | settings)
    prepared = prepare(scene, options.prepare)
    return prepared.scene, make_plan(prepared, options).superpixels


def test_gaussians_follow_the_number_of_superpixels(scene: Scene) -> None:
    images = scene.images.copy()
    images[1] = 0.5  # needs fewer superpixels than the others
    sh0 = scene.gaussians.sh0.copy()
    sh0[scene.pixels_per_view : 2 * scene.pixels_per_view] = 0  # of the same grey, or the photo would not count
    grey = replace(scene, images=images, gaussians=replace(scene.gaussians, sh0=sh0))
    canonical, choices = scene_and_choices(grey, **ADAPTIVE, k=2)
    segmentation = segment_scene(canonical, choices, None)
    groups = segmentation.groups
    assert groups.counts[1] < choices.limits.per_view < groups.counts[0]
    assert not segmentation.exact
    assert segmentation.count == round(choices.limits.default * len(groups) / (3 * choices.limits.per_view))
    for view, count in enumerate(groups.counts):
        assert np.unique(groups.labels[view]).tolist() == list(range(count))


def test_a_fit_begins_with_a_share_of_the_number(scene: Scene) -> None:
    whole = segment_scene(*scene_and_choices(scene, **ADAPTIVE), None)
    canonical, choices = scene_and_choices(scene, **ADAPTIVE, fit="full")
    assert choices.start_share < 1
    segmentation = segment_scene(canonical, choices, None)
    assert segmentation.count == pytest.approx(whole.count, rel=0.02)
    assert len(segmentation.groups) < 1.02 * choices.start_share * segmentation.count


def test_what_exceeds_a_limit_is_cut_to_it(scene: Scene) -> None:
    canonical, choices = scene_and_choices(scene, **ADAPTIVE)
    limit = segment_scene(canonical, choices, None).count - 20
    limited = segment_scene(canonical, replace(choices, limits=replace(choices.limits, max_count=limit)), None)
    assert (limited.count, limited.exact, len(limited.groups)) == (limit, True, limit)


def test_an_exact_number_is_met(scene: Scene) -> None:
    assert segment_scene(*scene_and_choices(scene, **ADAPTIVE | {"superpixels": 40}), None).groups.counts == (
        40,
        40,
        40,
    )
    assert len(segment_scene(*scene_and_choices(scene, **ADAPTIVE), 100).groups) == 100
    assert len(scenes.plain(scene, **ADAPTIVE, budget=90)) == 90


def test_largest_count(scene: Scene) -> None:
    def largest(**settings: object) -> int:
        options = CompactOptions().with_settings(settings)
        limits = count_limits(measure_size(scene), options.segment, options.decode, options.budget)
        assert limits.default == default_count(measure_size(scene), options.segment, options.decode)
        return largest_count(limits, options.segment)

    assert largest(superpixels="5%") == 3 * 38
    assert largest(**ADAPTIVE) == 4 * 3 * 38
    assert largest(**ADAPTIVE | {"superpixels": "90%"}) == 3 * 32 * 24
    assert largest(**ADAPTIVE | {"superpixels": 38}) == 3 * 38
