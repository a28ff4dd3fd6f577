"""Colours that photos of several batches say, one batch after the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from view_batches import fed, room, same_group, state_of

from gsmerge import Gaussians, Scene
from gsmerge.moments import feature_to_gaussians
from gsmerge.online.batch_photos import BatchPhotos, fit_batch_colors, groups_in_view
from gsmerge.online.state import GroupSet
from gsmerge.render.photos import Photos, scene_photos
from gsmerge.render.weights import apply
from gsmerge.stages.fit import FitOptions
from gsmerge.stages.fit.color import Drawn, draw, fit_colors
from gsmerge.types import SH_C0

FEW = FitOptions(holdout=0.05)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return room(6, 48, 36)


@pytest.fixture(scope="module")
def groups(scene: Scene) -> GroupSet:
    """Groups of all views, their colours off by a little."""
    actual = state_of(fed([scene], fit_colors=False)).groups
    noise = np.random.default_rng(0).normal(0, 0.1 / SH_C0, actual.features.sh0.shape).astype(np.float32)
    sh0 = actual.features.sh0 + noise
    return replace(actual, features=replace(actual.features, sh0=sh0), fitted_sh0=sh0)


@pytest.fixture(scope="module")
def batch_photos(scene: Scene) -> BatchPhotos:
    """Photos, in the state's own frame, with noise of their own."""
    state = state_of(fed([scene], fit_colors=False))
    assert scene.images is not None
    rng = np.random.default_rng(0)
    images = scene.images + rng.normal(0, 0.15, scene.images.shape).astype(np.float32)
    return BatchPhotos(images.clip(0, 1), state.cameras)


def some(batch_photos: BatchPhotos, *views: int) -> BatchPhotos:
    return BatchPhotos(batch_photos.images[list(views)], batch_photos.cameras[list(views)])


def rms(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.sqrt(((SH_C0 * (one - other)) ** 2).mean()))


# what the solver itself makes of it


@pytest.fixture(scope="module")
def drawn(groups: GroupSet, scene: Scene) -> tuple[Gaussians, Photos, Drawn]:
    gaussians = state_of(fed([scene], fit_colors=False)).frame.leave(feature_to_gaussians(groups.features))
    photos = scene_photos(scene, 2)
    return gaussians, photos, draw(gaussians, photos)


def test_nothing_held_is_the_usual_fit(drawn: tuple[Gaussians, Photos, Drawn]) -> None:
    gaussians, photos, views = drawn
    plain, report = fit_colors(gaussians, views, photos, FEW)
    none, other = fit_colors(gaussians, views, photos, FEW, 0, np.zeros(len(gaussians)))
    assert report.accepted
    assert scenes.identical(plain, none)
    assert report == other


def test_what_is_held_fast_stays(drawn: tuple[Gaussians, Photos, Drawn]) -> None:
    gaussians, photos, views = drawn
    precision = np.full(len(gaussians), 1e9)
    assert rms(fit_colors(gaussians, views, photos, FEW, 0, precision)[0].sh0, gaussians.sh0) < 1e-6
    precision[::2] = 0
    actual, report = fit_colors(gaussians, views, photos, FEW, 0, precision)
    assert report.accepted
    assert rms(actual.sh0[1::2], gaussians.sh0[1::2]) < 1e-6
    assert rms(actual.sh0[::2], gaussians.sh0[::2]) > 0.02


def test_the_more_is_held_the_less_moves(drawn: tuple[Gaussians, Photos, Drawn]) -> None:
    gaussians, photos, views = drawn
    moved = [
        rms(fit_colors(gaussians, views, photos, FEW, 0, np.full(len(gaussians), float(value)))[0].sh0, gaussians.sh0)
        for value in (0, 10, 100, 10_000)
    ]
    assert moved == sorted(moved, reverse=True)
    assert moved[-1] < 0.1 * moved[0]


def test_the_solution_is_where_the_gradient_vanishes(drawn: tuple[Gaussians, Photos, Drawn]) -> None:
    """The equations by hand: a dense least-squares problem with what is held on its diagonal."""
    gaussians, photos, views = drawn
    precision = np.random.default_rng(1).uniform(1, 50, len(gaussians))
    options = scenes.tuned(FEW, prior_weight=1e-9, iterations=400, huber=1e6, min_gain=1.0, max_gain=1.0)
    actual, report = fit_colors(gaussians, views, photos, options, 0, precision)
    assert report.accepted
    n = len(gaussians)
    rows = [np.stack([dense(view, j, n) for j in range(n)], 1) for view in views.views]
    residuals = [(p - i).reshape(-1, 3) for p, i in zip(photos.images, views.images, strict=True)]
    weights, right = np.concatenate(rows), np.concatenate(residuals)
    offsets = np.linalg.solve(weights.T @ weights + np.diag(precision), weights.T @ right)
    inside = np.abs(0.5 + SH_C0 * gaussians.sh0[:, 0] + offsets - 0.5) < 0.5  # colours are kept in range
    np.testing.assert_allclose(SH_C0 * (actual.sh0 - gaussians.sh0)[:, 0][inside], offsets[inside], atol=2e-3)


def dense(view: object, column: int, count: int) -> np.ndarray:
    """One column of a view's blending weights."""
    one = np.zeros((count, 1), np.float32)
    one[column] = 1
    return apply(view, one).reshape(-1).astype(np.float64)  # type: ignore[arg-type]


# batch by batch


def test_only_colours_in_view_and_what_holds_them_change(groups: GroupSet, batch_photos: BatchPhotos) -> None:
    one, means = some(batch_photos, 0), groups.features.means.copy()
    means[[3, 50]] += 30
    groups = replace(groups, features=replace(groups.features, means=means))
    actual, report = fit_batch_colors(groups, one, FEW)
    assert report.accepted
    seen = groups_in_view(groups.features, one.cameras)[0]
    assert 0 < seen.sum() < len(groups)
    for row in np.flatnonzero(~seen):
        assert same_group(actual, int(row), groups, int(row))
    np.testing.assert_array_equal(actual.features.sh0, groups.features.sh0)
    assert scenes.identical(actual.children, groups.children)
    assert (actual.color_precision[seen] >= groups.color_precision[seen]).all()
    assert float(actual.color_precision.sum()) > 0


def test_what_is_held_is_the_diagonal_of_the_equations(groups: GroupSet, batch_photos: BatchPhotos) -> None:
    """Squares of the blending weights in half-size photos."""
    actual, _ = fit_batch_colors(groups, batch_photos, FEW)
    views = draw(replace(feature_to_gaussians(groups.features), sh0=groups.fitted_sh0), batch_photos.photos(2)).views
    for g in range(0, len(groups), 7):
        expected = sum(float((dense(view, g, len(groups)) ** 2).sum()) for view in views)
        assert float(actual.color_precision[g]) == pytest.approx(expected, rel=1e-3, abs=1e-5)
    twice, _ = fit_batch_colors(actual, batch_photos, FEW)
    np.testing.assert_allclose(twice.color_precision, 2 * actual.color_precision, rtol=1e-5)


@pytest.mark.parametrize("tint", [(0.1, 0.0, -0.1), (-0.06, 0.1, 0.04)])
def test_one_batch_after_the_other_is_near_all_at_once(
    groups: GroupSet, batch_photos: BatchPhotos, tint: tuple[float, float, float]
) -> None:
    """Batches of other tints, which say different things: nearer than where earlier ones are forgotten."""
    steady = scenes.tuned(FEW, min_gain=1.0, max_gain=1.0)
    sides = np.array([1, -1, 1, -1, 1, -1], np.float32)[:, None, None, None]
    images = 0.6 * batch_photos.images + 0.2 + sides * np.array(tint, np.float32)
    tinted = BatchPhotos(images, batch_photos.cameras)
    joint, _ = fit_batch_colors(groups, tinted, steady)
    after = forgetful = groups
    for batch in (some(tinted, 0, 2, 4), some(tinted, 1, 3, 5)):
        after, report = fit_batch_colors(after, batch, steady)
        assert report.accepted
        unknown = np.zeros_like(groups.color_precision)
        forgetful, _ = fit_batch_colors(replace(forgetful, color_precision=unknown), batch, steady)
    assert rms(after.fitted_sh0, joint.fitted_sh0) < 0.8 * rms(forgetful.fitted_sh0, joint.fitted_sh0)
    assert rms(after.fitted_sh0, joint.fitted_sh0) < 0.7 * rms(joint.fitted_sh0, groups.fitted_sh0)
    np.testing.assert_allclose(after.color_precision, joint.color_precision, rtol=1e-4, atol=1e-4)


def test_the_threads_do_not_matter(groups: GroupSet, batch_photos: BatchPhotos) -> None:
    from gsmerge.runtime.threads import use_threads

    actual = []
    for threads in (1, 3):
        with use_threads(threads):
            actual.append(fit_batch_colors(groups, batch_photos, FEW)[0])
    np.testing.assert_array_equal(actual[0].fitted_sh0, actual[1].fitted_sh0)
    np.testing.assert_array_equal(actual[0].color_precision, actual[1].color_precision)


def test_views_that_see_nothing_say_nothing(groups: GroupSet, batch_photos: BatchPhotos) -> None:
    away = batch_photos.cameras[:1]
    turn = np.diag([-1.0, 1, -1, 1])
    away = replace(away, viewmats=turn @ away.viewmats)
    actual, report = fit_batch_colors(groups, BatchPhotos(batch_photos.images[:1], away), FEW)
    assert not report.accepted
    np.testing.assert_array_equal(actual.fitted_sh0, groups.fitted_sh0)
    np.testing.assert_array_equal(actual.color_precision, groups.color_precision)
