from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import PixelScene
from gsmerge.moments import Members, feature_to_gaussians, principal_axes, scene_members
from gsmerge.render.metrics import psnr
from gsmerge.render.photos import Photos, scene_photos
from gsmerge.stages.backing import BackingOptions, encode_backing
from gsmerge.stages.choose_merge import RobustMerge, RobustOptions, choose_merge, close_holes, merge_psnr, weigh
from gsmerge.stages.encode import EncodeOptions, encode
from gsmerge.stages.merge import take
from gsmerge.stages.segment import SegmentOptions, segment
from gsmerge.types import FeatureGaussians

NAMES = ["plain", "wide", "wide+back", "plain+weigh", "plain+weigh+back", "wide+weigh", "wide+weigh+back"]


@pytest.fixture(scope="module")
def scene() -> PixelScene:
    return scenes.make_scene(scenes.room(), scenes.arc(3), noise=0.02)


@pytest.fixture(scope="module")
def members(scene: PixelScene) -> Members:
    return scene_members(scene)


@pytest.fixture(scope="module")
def photos(scene: PixelScene) -> Photos:
    return scene_photos(scene)


@pytest.fixture(scope="module")
def features(scene: PixelScene, members: Members) -> FeatureGaussians:
    assert scene.images is not None
    return encode(scene, members, segment(scene.images, SegmentOptions(), 150), EncodeOptions())


@pytest.fixture(scope="module")
def backing(scene: PixelScene, members: Members, features: FeatureGaussians) -> FeatureGaussians:
    assert scene.images is not None
    groups = segment(scene.images, SegmentOptions(), 12)
    layer = encode_backing(scene, members, groups, BackingOptions(), features)
    assert layer is not None
    return layer


def test_best_score_wins(features: FeatureGaussians, backing: FeatureGaussians, photos: Photos) -> None:
    chosen = choose_merge(features, backing, photos, RobustOptions())
    name, scores = chosen.choices["merge"], chosen.choices["merge_scores"]
    assert sorted(scores) == sorted(NAMES)
    assert scores[name] == max(scores.values())
    assert merge_psnr([chosen.features], photos, left_out=True) == pytest.approx(scores[name], abs=1e-9)
    assert scores["plain"] == pytest.approx(merge_psnr([features], photos, left_out=True), abs=1e-9)
    assert bool(chosen.features.backing.any()) == name.endswith("back")


def test_leaving_out_renders_the_others_only(features: FeatureGaussians, photos: Photos, scene: PixelScene) -> None:
    gaussians = feature_to_gaussians(features)
    scores = []
    for view in range(3):
        image = scenes.images_of(gaussians[features.views != view], scene.cameras[view : view + 1])[0][0]
        scores.append(psnr(np.clip(image, 0, 1), photos.images[view]))
    assert merge_psnr([features], photos, left_out=True) == pytest.approx(np.mean(scores), abs=0.01)


def test_many_views_are_judged_by_some(
    features: FeatureGaussians, photos: Photos, scene: PixelScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each still without its own Gaussians."""
    monkeypatch.setattr("gsmerge.views.MAX_SCORED_VIEWS", 1)
    others = feature_to_gaussians(features)[features.views != 1]
    image = scenes.images_of(others, scene.cameras[1:2])[0][0]
    expected = psnr(np.clip(image, 0, 1), photos.images[1])
    assert merge_psnr([features], photos, left_out=True) == pytest.approx(expected, abs=0.01)


def test_weighing_lowers_what_other_photos_contradict(features: FeatureGaussians, photos: Photos) -> None:
    options = RobustOptions()
    wrong = np.arange(len(features)) % 10 == 0
    sh0 = features.sh0.copy()
    sh0[wrong] = -sh0[wrong] + 1.5
    gains = weigh(replace(features, sh0=sh0), photos, options)
    assert np.isfinite(gains).all()
    assert float(gains.min()) >= 0.05 * options.boost - 1e-6
    assert float(gains.max()) <= options.boost + 1e-6
    assert np.median(gains[wrong]) < 0.5 * np.median(gains[~wrong])


def test_unseen_ones_keep_the_boost(features: FeatureGaussians, photos: Photos) -> None:
    lost = replace(features, means=np.concatenate([features.means[:5] - 100, features.means[5:]]))
    assert weigh(lost, photos, RobustOptions())[:5].tolist() == pytest.approx([3.0] * 5)


def test_backing_lies_behind_and_covers_the_image(
    scene: PixelScene, features: FeatureGaussians, backing: FeatureGaussians
) -> None:
    options = BackingOptions()
    assert backing.backing.all()
    assert len(backing) == 36
    eyes = scene.cameras.centres
    distance = np.linalg.norm(backing.means - eyes[backing.views], axis=1)
    surface = scenes.trace(scenes.room(), scene.cameras)[1]
    assert float(distance.min()) > (1 + options.push) * surface.min() * 0.95
    gaussians = feature_to_gaussians(backing)
    for view in range(3):
        own = gaussians[backing.views == view]
        assert scenes.images_of(own, scene.cameras[view : view + 1])[1].mean() > 0.65


def test_backing_draws_no_curtain() -> None:
    """Colours that cross a depth edge: the layer stays near the median depth of each superpixel."""
    grey = scenes.flat(0.5, 0.5, 0.5)
    surfaces = [scenes.plane(1.5, grey, right=0.0), scenes.plane(6.0, grey)]
    edge = scenes.make_scene(surfaces, scenes.arc(1))
    assert edge.images is not None
    groups = segment(edge.images, SegmentOptions(), 6)
    members = scene_members(edge)
    front = encode(edge, members, groups, EncodeOptions())
    layer = encode_backing(edge, members, groups, BackingOptions(push=0.0), front)
    assert layer is not None
    thickness = principal_axes(layer.covars)[0][:, 0]
    depths = layer.means[:, 2].astype(np.float64)
    assert (thickness < 0.3 * depths).all()


# one or two views, no backing layer


@pytest.mark.parametrize("views", [1, 2])
def test_few_views_differ_in_spread_alone(scene: PixelScene, members: Members, views: int) -> None:
    """Rendered from everything, since nothing can be left out."""
    own = scenes.take_views(scene, list(range(views)))
    assert own.images is not None
    features = encode(own, scene_members(own), segment(own.images, SegmentOptions(), 150), EncodeOptions())
    photos = scene_photos(own)
    chosen = choose_merge(features, None, photos, RobustOptions())
    name, scores = chosen.choices["merge"], chosen.choices["merge_scores"]
    assert list(scores) == ["plain", "wide", "wider"]
    assert scores[name] == max(scores.values())
    power = list(scores).index(name)
    np.testing.assert_allclose(chosen.features.spreads, np.full(len(features), 1.2**power), rtol=1e-6)
    for name in ("means", "covars", "gains", "extinctions"):
        assert np.array_equal(getattr(chosen.features, name), getattr(features, name))
    assert scores["plain"] == pytest.approx(merge_psnr([features], photos, left_out=False), abs=1e-9)


def test_without_a_backing_layer_no_candidate_has_one(features: FeatureGaussians, photos: Photos) -> None:
    chosen = choose_merge(features, None, photos, RobustOptions())
    scores = chosen.choices["merge_scores"]
    assert sorted(scores) == sorted(name for name in NAMES if not name.endswith("back"))
    assert not chosen.features.backing.any()


def test_rendering_everything_shows_more(features: FeatureGaussians, photos: Photos, scene: PixelScene) -> None:
    gaussians = feature_to_gaussians(features)
    images = scenes.images_of(gaussians, scene.cameras)[0]
    expected = np.mean([psnr(np.clip(i, 0, 1), p) for i, p in zip(images, photos.images, strict=True)])
    everything = merge_psnr([features], photos, left_out=False)
    assert everything == pytest.approx(expected, abs=0.01)
    assert everything > merge_psnr([features], photos, left_out=True)


# holes after merging


def before(coarse: FeatureGaussians | None, photos: Photos) -> RobustMerge:
    """A choice whose features do not matter any more."""
    return RobustMerge(take_none(), coarse, photos, {})


def take_none() -> FeatureGaussians:
    return scenes.make_features(np.zeros((0, 3)))


def test_holes_are_closed_by_what_shows_the_photos_best(
    features: FeatureGaussians, backing: FeatureGaussians, photos: Photos
) -> None:
    """A thinned layer: every candidate is tried, and the best is taken."""
    thin = take(features, np.arange(0, len(features), 2))
    chosen = close_holes(thin, before(backing, photos), RobustOptions())
    name, scores = chosen.choices["closed"], chosen.choices["closed_scores"]
    assert list(scores) == ["as it is", "wide", "back", "wide+back"]
    assert scores[name] == max(scores.values())
    assert name != "as it is"
    assert merge_psnr([chosen.features], photos, left_out=False) == pytest.approx(scores[name], abs=1e-9)
    assert bool(chosen.features.backing.any()) == name.endswith("back")


def test_closed_layers_stay_as_they_are(features: FeatureGaussians, photos: Photos) -> None:
    """Where nothing may be added, the very same Feature Gaussians come back."""
    wide = replace(features, spreads=1.2 * features.spreads)
    chosen = close_holes(wide, before(None, photos), RobustOptions())
    scores = chosen.choices["closed_scores"]
    assert list(scores) == ["as it is"]
    assert chosen.features is wide


def test_candidates_are_not_widened_or_backed_twice(
    features: FeatureGaussians, backing: FeatureGaussians, photos: Photos
) -> None:
    options = RobustOptions()
    wide = replace(features, spreads=1.2 * features.spreads)
    backed = FeatureGaussians.concat([features, backing])
    assert list(close_holes(wide, before(backing, photos), options).choices["closed_scores"]) == ["as it is", "back"]
    assert list(close_holes(backed, before(backing, photos), options).choices["closed_scores"]) == ["as it is", "wide"]
    both = FeatureGaussians.concat([wide, backing])
    assert list(close_holes(both, before(backing, photos), options).choices["closed_scores"]) == ["as it is"]
    assert list(close_holes(backing, before(None, photos), options).choices["closed_scores"]) == ["as it is"]
