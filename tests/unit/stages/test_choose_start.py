"""Which start is kept, the one with networks or the one without, and the score that decides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
import unaligned_scenes
from network_fixtures import Made, made, noisy, untrained

from gsmerge import Gaussians, Scene
from gsmerge.networks.apply import encode_features
from gsmerge.networks.weights import NetworkWeights
from gsmerge.raster.photos import render_photos, scene_photos, scene_pictures
from gsmerge.runtime.record import record_run
from gsmerge.settings.stages import DecodeOptions
from gsmerge.stages.choose_start import choose_start, views_psnr
from gsmerge.stages.decode import decode
from gsmerge.stages.merge import MergedViews
from gsmerge.types import Groups, Segmentation, grid_ids


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3), noise=0.02)


@pytest.fixture(scope="module")
def gaussians(scene: Scene) -> Gaussians:
    return scenes.plain(scene)


# the score


def test_all_pixels_of_the_half_size_views_count(scene: Scene, gaussians: Gaussians) -> None:
    photos = scene_photos(scene, 2)
    images = np.stack(render_photos(gaussians, photos)).clip(0, 1)
    expected = -10 * np.log10(((images - photos.images) ** 2).mean(dtype=np.float64))
    assert views_psnr(gaussians, scene) == pytest.approx(expected, abs=1e-4)


def test_pixels_without_a_gaussian_do_not_count(scene: Scene, gaussians: Gaussians) -> None:
    valid = np.ones_like(scene.valid)
    valid[:, :, :12] = False
    spoilt = np.where(valid[..., None], scene.images, 1 - scene.images)
    some = replace(scene, pixel_ids=grid_ids(valid))
    assert views_psnr(gaussians, replace(some, images=spoilt)) == views_psnr(gaussians, some)
    assert views_psnr(gaussians, replace(scene, images=spoilt)) < views_psnr(gaussians, scene) - 3


def test_where_gaussians_belong_to_no_pixel_all_pixels_count(scene: Scene, gaussians: Gaussians) -> None:
    assert scene.valid.all()
    assert views_psnr(gaussians, unaligned_scenes.without_order(scene)) == views_psnr(gaussians, scene)


def test_many_views_are_judged_by_some(scene: Scene, gaussians: Gaussians, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsmerge.stages.choose_start.MAX_VIEWS", 1)
    assert views_psnr(gaussians, scene) == views_psnr(gaussians, scenes.take_views(scene, [1]))


def test_without_photos_the_colours_of_the_pixels_stand_in(scene: Scene, gaussians: Gaussians) -> None:
    bare = replace(scene, images=None)
    assert views_psnr(gaussians, bare) == views_psnr(gaussians, replace(scene, images=scene_pictures(bare)))


# the choice


@pytest.fixture(scope="module")
def some() -> Made:
    return made()


def starts_of(some: Made, networks: NetworkWeights) -> list[MergedViews]:
    """The start with these networks, then the analytic one."""
    labels = np.zeros(some.scene.valid.shape, np.int32)
    segmentation = Segmentation(Groups(labels, (1,) * len(some.scene)), len(some.features), exact=False)
    context = some.networks(networks)
    learned = MergedViews(encode_features(some.features, context), some.members, segmentation, 1, context)
    return [learned, MergedViews(some.features, some.members, segmentation, 2)]


@pytest.mark.parametrize("better", ["learned", "analytic"])
def test_the_better_start_is_kept(some: Made, better: str) -> None:
    """As it is, with both scores and its Gaussians at K = 1, whatever K is asked for."""
    learned, analytic = starts_of(some, noisy())
    if better == "learned":
        features = analytic.features
        analytic = replace(analytic, features=replace(features, means=features.means + 100))
    options = DecodeOptions(k=4)
    with record_run() as record:
        chosen = choose_start([learned, analytic], some.scene, options, None)
    expected = learned if better == "learned" else analytic
    assert chosen.features is expected.features
    assert chosen.networks is expected.networks
    scores = record.choices["start_scores"]
    assert sorted(scores) == ["analytic", "learned"]
    assert max(scores, key=scores.__getitem__) == better
    assert record.choices["groups"] == expected.num_groups
    ones = decode(expected.features, some.members, replace(options, k=1), networks=expected.networks)
    assert scenes.identical(chosen.k1_gaussians, ones)
    assert scores[better] == views_psnr(ones, some.scene)


def test_of_equal_starts_the_analytic_one_is_kept(some: Made) -> None:
    """Untrained networks correct nothing."""
    with record_run() as record:
        chosen = choose_start(starts_of(some, untrained()), some.scene, DecodeOptions(), None)
    assert chosen.networks is None
    assert len(set(record.choices["start_scores"].values())) == 1
