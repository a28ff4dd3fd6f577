"""How many superpixels a scene gets where they adapt to the pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import CompactOptions, PixelScene
from gsmerge.stages.group import default_count, largest_count, segment_scene
from gsmerge.stages.prepare import PreparedScene, prepare

ADAPTIVE = {"segmentation": "bass-adaptive", "superpixels": "5%"}


@pytest.fixture(scope="module")
def scene() -> PixelScene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24), noise=0.01)


def prepared_scene(scene: PixelScene, **settings: object) -> PreparedScene:
    return prepare(scene, CompactOptions().with_settings({"fit": "none"} | settings))


def test_gaussians_follow_the_number_of_superpixels(scene: PixelScene) -> None:
    assert scene.images is not None
    images = scene.images.copy()
    images[1] = 0.5  # needs fewer superpixels than the others
    sh0 = scene.gaussians.sh0.copy()
    sh0[scene.pixels_per_view : 2 * scene.pixels_per_view] = 0  # of the same grey, or the photo would not count
    grey = replace(scene, images=images, gaussians=replace(scene.gaussians, sh0=sh0))
    prepared = prepared_scene(grey, **ADAPTIVE, k=2)
    segmentation = segment_scene(prepared, None)
    groups = segmentation.groups
    assert groups.counts[1] < prepared.limits.per_view < groups.counts[0]
    assert not segmentation.exact
    assert segmentation.count == round(prepared.limits.default * len(groups) / (3 * prepared.limits.per_view))
    for view, count in enumerate(groups.counts):
        assert np.unique(groups.labels[view]).tolist() == list(range(count))


def test_a_fit_begins_with_a_share_of_the_number(scene: PixelScene) -> None:
    whole = segment_scene(prepared_scene(scene, **ADAPTIVE), None)
    prepared = prepared_scene(scene, **ADAPTIVE, fit="full")
    limits = prepared.limits
    assert limits.share < 1
    segmentation = segment_scene(prepared, None)
    assert segmentation.count == pytest.approx(whole.count, rel=0.02)
    assert len(segmentation.groups) < 1.02 * limits.share * segmentation.count


def test_what_exceeds_a_limit_is_cut_to_it(scene: PixelScene) -> None:
    prepared = prepared_scene(scene, **ADAPTIVE)
    usual = segment_scene(prepared, None)
    limit = usual.count - 20
    limited = segment_scene(replace(prepared, limits=replace(prepared.limits, max_count=limit)), None)
    assert (limited.count, limited.exact, len(limited.groups)) == (limit, True, limit)


def test_an_exact_number_is_met(scene: PixelScene) -> None:
    assert segment_scene(prepared_scene(scene, **ADAPTIVE | {"superpixels": 40}), None).groups.counts == (40, 40, 40)
    assert len(segment_scene(prepared_scene(scene, **ADAPTIVE), 100).groups) == 100
    assert len(scenes.compacted(scene, **ADAPTIVE, budget=90).gaussians) == 90


def test_largest_count(scene: PixelScene) -> None:
    fixed = CompactOptions().with_settings({"superpixels": "5%"})
    assert largest_count(scene, fixed) == default_count(scene, fixed) == 3 * 38
    adaptive = CompactOptions().with_settings(ADAPTIVE)
    assert largest_count(scene, adaptive) == 4 * 3 * 38
    assert largest_count(scene, adaptive.with_settings({"superpixels": "90%"})) == 3 * 32 * 24
    assert largest_count(scene, adaptive.with_settings({"superpixels": 38})) == 3 * 38


def test_a_whole_run(scene: PixelScene) -> None:
    result = scenes.compacted(scene, **ADAPTIVE)
    assert len(result.gaussians) <= 4 * 3 * 38
    assert scenes.identical(result.gaussians, scenes.compacted(scene, **ADAPTIVE, threads=1).gaussians)
