"""The state of a fit is made of Gaussians, grown, and judged on held-out patches."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scenes

from gsmerge import Gaussians, Scene
from gsmerge.method.fit.fit_state import FitState, gaussians_of, start_state
from gsmerge.method.fit.growth import FADED, error_masses, grow, grow_to
from gsmerge.method.fit.photo_sizes import holdout_psnr, reduced, training_weights
from gsmerge.method.geometry.transforms import covariances
from gsmerge.method.kernels import elementary
from gsmerge.method.kernels.gaussians.optimise import COLOR, COLUMNS, LOGIT, QUAT, SIZE
from gsmerge.method.raster.metrics import psnr
from gsmerge.method.raster.photos import Photos, scene_photos


@cache
def make_scene_of_degree(degree: int) -> tuple[Scene, Gaussians]:
    scene = scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24), degree=degree)
    actual = scenes.plain(scene, superpixels="8%")
    return scene, replace(actual, means=actual.means.astype(np.float32))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene_of_degree(0)[0]


@pytest.fixture(scope="module")
def gaussians() -> Gaussians:
    return make_scene_of_degree(0)[1]


@pytest.fixture(scope="module")
def photos() -> Photos:
    return scene_photos(make_scene_of_degree(0)[0])


def state_with_past(gaussians: Gaussians) -> FitState:
    """Return a state with some past."""
    state = start_state(gaussians)
    rng = np.random.default_rng(0)
    state.m[:] = rng.normal(size=state.m.shape)
    state.v[:] = rng.uniform(size=state.v.shape)
    state.x0 -= np.float32(0.01)
    state.units *= np.float32(1.5)
    state.box_shares[:] = rng.uniform(size=len(state.x))
    state.min_sizes[:] = rng.normal(size=len(state.x))
    return state


def covariances_of(x: np.ndarray) -> np.ndarray:
    made = x.astype(np.float64)
    return covariances(made[:, QUAT:LOGIT], elementary.exp(made[:, SIZE:QUAT]))


# the state


@pytest.mark.parametrize("degree", [0, 3])
def test_gaussians_are_read_back_from_a_fit_state(degree: int) -> None:
    _, gaussians = make_scene_of_degree(degree)
    state = start_state(gaussians)
    assert state.x.shape == (len(gaussians), COLUMNS)
    assert state.x.dtype == np.float32
    actual = gaussians_of(state.x, state.splats.shN)
    assert actual.sh_degree == degree
    np.testing.assert_array_equal(actual.means, gaussians.means)
    np.testing.assert_array_equal(actual.quats, gaussians.quats)
    np.testing.assert_array_equal(actual.shN, gaussians.shN)
    np.testing.assert_allclose(actual.scales, gaussians.scales, rtol=1e-5, atol=0)
    np.testing.assert_allclose(actual.opacities, gaussians.opacities, rtol=0, atol=1e-6)
    np.testing.assert_allclose(actual.sh0, gaussians.sh0, rtol=0, atol=1e-6)
    for name in scenes.FIELDS:
        assert getattr(actual, name).dtype == np.float32


def test_a_fit_state_of_extreme_opacities_and_scales_is_finite(gaussians: Gaussians) -> None:
    opacities, scales = np.array([0.0, 1.0, 1e-9, 0.5], np.float32), np.array([[0.0, 1e-30, 1e6]] * 4, np.float32)
    hard = replace(gaussians[:4], opacities=opacities, scales=scales)
    state = start_state(hard)
    assert np.isfinite(state.x).all()
    assert np.isfinite(state.units).all()


def test_view_colors_bring_the_harmonics_up_to_date() -> None:
    """Below degree 1 the colours themselves; above, the harmonics with the present base colour."""
    flat = start_state(make_scene_of_degree(0)[1])
    assert flat.view_colors() is flat.colors
    shiny = start_state(make_scene_of_degree(3)[1])
    shiny.colors[:] = 0.5
    assert shiny.view_colors() is None
    np.testing.assert_array_equal(shiny.splats.sh0, 0)


# growing


@pytest.mark.parametrize("more", [0, 1, 7, 40])
def test_growing_a_state_gives_exactly_the_count_asked_for(gaussians: Gaussians, photos: Photos, more: int) -> None:
    state = start_state(gaussians)
    grown, _ = grow(state, error_masses(state, photos), len(gaussians) + more)
    assert len(grown.x) == len(gaussians) + more
    for array in (grown.x0, grown.m, grown.v, grown.units, grown.colors, *vars(grown.splats).values()):
        assert len(array) in (len(grown.x), 3)
    if more == 0:
        assert grown is state


def test_growing_a_state_doubles_it_at_most(gaussians: Gaussians, photos: Photos) -> None:
    state = start_state(gaussians)
    masses = error_masses(state, photos)
    assert len(grow(state, masses, 10 * len(gaussians))[0].x) == 2 * len(gaussians)
    assert len(grow(state, masses, 3)[0].x) == len(gaussians)


def test_two_halves_have_the_moments_of_their_parent(gaussians: Gaussians, photos: Photos) -> None:
    """Mean and covariance of the pair are those of the parent: exactly, the axes across included."""
    state = start_state(gaussians)
    n = len(gaussians)
    grown, _ = grow(state, error_masses(state, photos), 2 * n)
    first, second = grown.x[:n], grown.x[n:]
    np.testing.assert_allclose((first[:, :3] + second[:, :3]) / 2, state.x[:, :3], atol=1e-6)
    own = covariances_of(first)
    np.testing.assert_array_equal(covariances_of(second), own)
    apart = (second - first)[:, :3].astype(np.float64) / 2
    pair = own + apart[:, :, None] * apart[:, None]
    expected = covariances_of(state.x)
    assert (np.abs(pair - expected).max((1, 2)) <= 1e-4 * np.abs(expected).max((1, 2))).all()
    longest = state.x[:, SIZE:QUAT].max(1)
    np.testing.assert_allclose(np.linalg.norm(apart, axis=1), 0.7 * np.exp(longest), rtol=1e-4)
    np.testing.assert_array_equal(first[:, COLOR:], state.x[:, COLOR:])
    np.testing.assert_array_equal(first[:, QUAT:LOGIT], state.x[:, QUAT:LOGIT])


def test_two_halves_cover_what_their_parent_covered(gaussians: Gaussians, scene: Scene, photos: Photos) -> None:
    """Each is clearer than the parent; both together cover a little more, so as to close gaps."""
    state = start_state(gaussians)
    n = len(gaussians)
    grown, _ = grow(state, error_masses(state, photos), 2 * n)
    assert (grown.splats.opacities[:n] < state.splats.opacities).all()
    before, after = (scenes.images_of(gaussians_of(s.x, s.splats.shN), scene.cameras)[1].mean() for s in (state, grown))
    assert before <= after <= before + 0.1


def test_rows_that_are_not_halved_stay_as_they_are(gaussians: Gaussians, photos: Photos) -> None:
    """In order, with its past and its start; halves have their parent's past and start where they are."""
    state, n = state_with_past(gaussians), len(gaussians)
    grown, _ = grow(state, error_masses(state, photos), n + 9)
    worst = np.sort(np.argsort(-error_masses(state, photos), kind="stable")[:9])
    rest = np.setdiff1d(np.arange(n), worst)
    for name in ("x", "x0", "m", "v", "units", "box_shares", "min_sizes", "colors"):
        np.testing.assert_array_equal(getattr(grown, name)[rest], getattr(state, name)[rest], err_msg=name)
    halves = np.concatenate([worst, np.arange(n, n + 9)])
    parents = np.concatenate([worst, worst])
    np.testing.assert_array_equal(grown.m[halves], state.m[parents])
    np.testing.assert_array_equal(grown.v[halves], state.v[parents])
    np.testing.assert_array_equal(grown.box_shares[halves], state.box_shares[parents])
    np.testing.assert_array_equal(grown.min_sizes[halves], state.min_sizes[parents])
    np.testing.assert_array_equal(grown.x0[halves], grown.x[halves])
    own = np.sort(grown.x[halves, SIZE:QUAT], 1)[:, 1:].mean(1)
    np.testing.assert_allclose(grown.units[halves], np.exp(own), rtol=1e-5)


def test_halves_inherit_the_harmonics_of_their_parent(photos: Photos) -> None:
    _, gaussians = make_scene_of_degree(3)
    state, n = start_state(gaussians), len(gaussians)
    grown, _ = grow(state, error_masses(state, photos), 2 * n)
    np.testing.assert_array_equal(grown.splats.shN[:n], state.splats.shN)
    np.testing.assert_array_equal(grown.splats.shN[n:], state.splats.shN)


def test_growing_happens_where_the_error_is(scene: Scene, gaussians: Gaussians) -> None:
    """Photos of the Gaussians themselves but for a corner of every one."""
    images = scenes.images_of(gaussians, scene.cameras)[0].astype(np.float32)
    images[:, :12, :16] = 1 - images[:, :12, :16]
    spoilt = replace(scene_photos(scene), images=images)
    state, n = start_state(gaussians), len(gaussians)
    masses = error_masses(state, spoilt)
    assert (masses >= 0).all()
    grown, _ = grow(state, error_masses(state, spoilt), n + 5)
    for view in range(3):
        centres = grown.x[n:, :3] @ spoilt.viewmats[view, :3, :3].T + spoilt.viewmats[view, :3, 3]
        pixels = centres @ spoilt.Ks[view].T
        assert (pixels[:, :2] / pixels[:, 2:] < [20, 16]).all()


def test_unseen_gaussians_have_no_error_to_be_halved_for(gaussians: Gaussians, photos: Photos) -> None:
    behind = replace(gaussians[:5], means=gaussians.means[:5] - 100)
    state = start_state(Gaussians.concat([behind, gaussians]))
    assert (error_masses(state, photos)[:5] == 0).all()
    grown, _ = grow(state, error_masses(state, photos), len(state.x) + len(gaussians) // 2)
    np.testing.assert_array_equal(grown.x[:5], state.x[:5])


# held-out patches


@pytest.mark.parametrize("size", [(96, 64), (33, 17), (8, 6), (2, 2), (1, 5)])
def test_every_view_holds_out_some_pixels(size: tuple[int, int]) -> None:
    photos = scene_photos(scenes.make_scene(scenes.wall(), scenes.arc(3, *size)))
    for seed in range(5):
        weights = training_weights(photos, 0.05, seed)
        assert len(weights) == 3
        for weight in weights:
            assert weight.shape == size[::-1]
            assert set(np.unique(weight).tolist()) == {0.0, 1.0}


def test_held_out_patches_have_their_share_at_random() -> None:
    photos = scene_photos(scenes.make_scene(scenes.wall(), scenes.arc(4, 128, 128)))
    box_shares = [1 - np.mean(training_weights(photos, share, 0)) for share in (0.05, 0.25, 0.6)]
    assert box_shares == pytest.approx([0.06, 0.25, 0.6], abs=0.12)
    one, other = (np.stack(training_weights(photos, 0.3, seed)) for seed in (0, 1))
    assert (one != other).any()
    assert (one[0] != one[1]).any()
    np.testing.assert_array_equal(one, np.stack(training_weights(photos, 0.3, 0)))


@pytest.mark.parametrize("size", [(96, 64), (97, 63)])
def test_reduced_weights_hold_out_the_same_places(size: tuple[int, int]) -> None:
    scene = scenes.make_scene(scenes.wall(), scenes.arc(2, *size))
    full, half = scene_photos(scene), scene_photos(scene, 2)
    weights = training_weights(full, 0.3, 0)
    for weight, small in zip(weights, reduced(weights, half), strict=True):
        assert small.shape == (half.height, half.width)
        assert small.mean() == pytest.approx(weight.mean(), abs=0.05)
        np.testing.assert_array_equal(small, weight[::2, ::2][: half.height, : half.width])


def test_holdout_psnr_looks_at_held_out_pixels_only(photos: Photos) -> None:
    weights = training_weights(photos, 0.2, 0)
    images = [photo.copy() for photo in photos.images]
    for image, weight in zip(images, weights, strict=True):
        image[weight == 1] = 9.0
    assert holdout_psnr(images, photos, weights, np.inf) == pytest.approx(120)
    rng = np.random.default_rng(0)
    noisy = [photo + 0.1 * rng.normal(size=photo.shape).astype(np.float32) for photo in photos.images]
    held = np.concatenate([np.clip(n, 0, 1)[w == 0] for n, w in zip(noisy, weights, strict=True)])
    truth = np.concatenate([p[w == 0] for p, w in zip(photos.images, weights, strict=True)])
    assert holdout_psnr(noisy, photos, weights, np.inf) == pytest.approx(psnr(held[None], truth[None]), abs=1e-3)


def test_holdout_psnr_sets_exposure_aside(photos: Photos) -> None:
    """Views that are brighter or darker than the mean cost nothing; what they have in common still counts."""
    weights = training_weights(photos, 0.2, 0)
    factors = np.array([0.8, 1.25] * len(photos), np.float32)[: len(photos)]
    factors /= elementary.exp(elementary.log(factors).mean())
    images = [0.5 * photo / factor for photo, factor in zip(photos.images, factors, strict=True)]
    halved = replace(photos, images=0.5 * photos.images)
    assert holdout_psnr(images, halved, weights, 1.15) > 60  # dB: equal but for rounding
    assert holdout_psnr(images, halved, weights, np.inf) < 40  # dB: the exposures of 0.8 and 1.25 count
    assert holdout_psnr(images, photos, weights, 1.15) < 15  # dB: all views are half as bright


# what has faded


def test_growth_spends_the_count_on_what_can_be_seen(gaussians: Gaussians, photos: Photos) -> None:
    opacities = gaussians.opacities.clip(0.3, 0.9)
    opacities[::7] = 0.0041
    state = start_state(replace(gaussians, opacities=opacities))
    grown = grow_to(state, photos, len(gaussians) + 9)
    assert len(grown.x) == len(gaussians) + 9
    assert not np.isin(grown.origins, np.arange(len(gaussians))[::7]).any()
    assert grown.splats.opacities.min() > FADED


def test_chosen_rows_of_a_state_keep_their_past(gaussians: Gaussians) -> None:
    rows = state_with_past(gaussians)[np.array([4, 2])]
    for name in ("x", "x0", "m", "v", "units", "box_shares", "min_sizes"):
        np.testing.assert_array_equal(getattr(rows, name), getattr(state_with_past(gaussians), name)[[4, 2]])
    assert rows.origins.tolist() == [4, 2]


def test_halves_of_a_faint_gaussian_are_still_drawn(gaussians: Gaussians, photos: Photos) -> None:
    faint = start_state(replace(gaussians, opacities=np.full_like(gaussians.opacities, FADED * 1.0001)))
    grown, _ = grow(faint, error_masses(faint, photos), 2 * len(gaussians))
    assert len(grown.x) > len(gaussians)
    assert grown.splats.opacities.min() >= 1 / 255


def test_a_faint_scene_keeps_its_count_when_it_grows(gaussians: Gaussians, photos: Photos) -> None:
    faint = start_state(replace(gaussians, opacities=np.full_like(gaussians.opacities, 0.0045)))
    assert len(grow_to(faint, photos, len(gaussians)).x) == len(gaussians)
