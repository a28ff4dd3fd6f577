"""Colours that photos of several batches say, one batch after the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
import torch
from arriving import fed, room, same_group, state_of

from gsmerge import Gaussians, PixelScene
from gsmerge.moments import feature_to_gaussians
from gsmerge.online.colors import solve_colors
from gsmerge.online.cover import in_view
from gsmerge.online.pictures import Shots
from gsmerge.online.state import Parts
from gsmerge.render.photos import Photos, scene_photos
from gsmerge.render.weights import apply
from gsmerge.stages.fit import FitOptions
from gsmerge.stages.fit.color import Drawn, draw, fit_colors
from gsmerge.types import SH_C0

FEW = FitOptions(fit="color", holdout=0.05)


@pytest.fixture(scope="module")
def scene() -> PixelScene:
    return room(6, 48, 36)


@pytest.fixture(scope="module")
def parts(scene: PixelScene) -> Parts:
    """Groups of all views, their colours off by a little."""
    found = state_of(fed([scene], fit="none")).parts
    rng = torch.Generator().manual_seed(0)
    sh0 = found.features.sh0 + 0.1 / SH_C0 * torch.randn(found.features.sh0.shape, generator=rng)
    return replace(found, features=replace(found.features, sh0=sh0), solved=sh0)


@pytest.fixture(scope="module")
def shots(scene: PixelScene) -> Shots:
    """Photos, in the state's own frame, with noise of their own."""
    state = state_of(fed([scene], fit="none"))
    assert scene.images is not None
    rng = np.random.default_rng(0)
    images = scene.images.numpy() + rng.normal(0, 0.15, scene.images.shape).astype(np.float32)
    return Shots(images.clip(0, 1), state.cameras)


def some(shots: Shots, *views: int) -> Shots:
    return Shots(shots.images[list(views)], shots.cameras[torch.tensor(views)])


def rms(one: torch.Tensor, other: torch.Tensor) -> float:
    return float((SH_C0 * (one - other)).square().mean().sqrt())


# what the solver itself makes of it


@pytest.fixture(scope="module")
def drawn(parts: Parts, scene: PixelScene) -> tuple[Gaussians, Photos, Drawn]:
    gaussians = state_of(fed([scene], fit="none")).frame.leave(feature_to_gaussians(parts.features))
    photos = scene_photos(scene, 2)
    return gaussians, photos, draw(gaussians, photos)


def test_nothing_held_is_the_usual_fit(drawn: tuple[Gaussians, Photos, Drawn]) -> None:
    gaussians, photos, views = drawn
    plain, report = fit_colors(gaussians, views, photos, FEW)
    none, other = fit_colors(gaussians, views, photos, FEW, held=np.zeros(len(gaussians)))
    assert report.accepted
    assert scenes.identical(plain, none)
    assert report == other


def test_what_is_held_fast_stays(drawn: tuple[Gaussians, Photos, Drawn]) -> None:
    gaussians, photos, views = drawn
    held = np.full(len(gaussians), 1e9)
    assert rms(fit_colors(gaussians, views, photos, FEW, held=held)[0].sh0, gaussians.sh0) < 1e-6
    held[::2] = 0
    found, report = fit_colors(gaussians, views, photos, FEW, held=held)
    assert report.accepted
    assert rms(found.sh0[1::2], gaussians.sh0[1::2]) < 1e-6
    assert rms(found.sh0[::2], gaussians.sh0[::2]) > 0.02


def test_the_more_is_held_the_less_moves(drawn: tuple[Gaussians, Photos, Drawn]) -> None:
    gaussians, photos, views = drawn
    moved = [
        rms(fit_colors(gaussians, views, photos, FEW, held=np.full(len(gaussians), float(held)))[0].sh0, gaussians.sh0)
        for held in (0, 10, 100, 10_000)
    ]
    assert moved == sorted(moved, reverse=True)
    assert moved[-1] < 0.1 * moved[0]


def test_the_solution_is_where_the_gradient_vanishes(drawn: tuple[Gaussians, Photos, Drawn]) -> None:
    """The equations by hand: a dense least-squares problem with what is held on its diagonal."""
    gaussians, photos, views = drawn
    held = np.random.default_rng(1).uniform(1, 50, len(gaussians))
    options = replace(FEW, prior_weight=1e-9, iterations=400, huber=1e6, min_gain=1.0, max_gain=1.0)
    found, report = fit_colors(gaussians, views, photos, options, held=held)
    assert report.accepted
    n = len(gaussians)
    rows = [np.stack([dense(view, j, n) for j in range(n)], 1) for view in views.views]
    residuals = [(p - i).reshape(-1, 3) for p, i in zip(photos.images, views.images, strict=True)]
    weights, right = np.concatenate(rows), np.concatenate(residuals)
    offsets = np.linalg.solve(weights.T @ weights + np.diag(held), weights.T @ right)
    inside = np.abs(0.5 + SH_C0 * gaussians.sh0[:, 0].numpy() + offsets - 0.5) < 0.5  # colours are kept in range
    np.testing.assert_allclose(SH_C0 * (found.sh0 - gaussians.sh0)[:, 0].numpy()[inside], offsets[inside], atol=2e-3)


def dense(view: object, column: int, count: int) -> np.ndarray:
    """One column of a view's blending weights."""
    one = np.zeros((count, 1), np.float32)
    one[column] = 1
    return apply(view, one).reshape(-1).astype(np.float64)  # type: ignore[arg-type]


# batch by batch


def test_only_colours_in_view_and_what_holds_them_change(parts: Parts, shots: Shots) -> None:
    one, means = some(shots, 0), parts.features.means.clone()
    means[[3, 50]] += 30
    parts = replace(parts, features=replace(parts.features, means=means))
    found, report = solve_colors(parts, one, FEW)
    assert report.accepted
    seen = in_view(parts.features, one.cameras)[0]
    assert 0 < seen.sum() < len(parts)
    for row in np.flatnonzero(~seen):
        assert same_group(found, int(row), parts, int(row))
    assert torch.equal(found.features.sh0, parts.features.sh0)
    assert scenes.identical(found.children, parts.children)
    assert (found.held[torch.from_numpy(seen)] >= parts.held[torch.from_numpy(seen)]).all()
    assert float(found.held.sum()) > 0


def test_what_is_held_is_the_diagonal_of_the_equations(parts: Parts, shots: Shots) -> None:
    """Squares of the blending weights in half-size photos."""
    found, _ = solve_colors(parts, shots, FEW)
    views = draw(replace(feature_to_gaussians(parts.features), sh0=parts.solved), shots.photos(2)).views
    for g in range(0, len(parts), 7):
        wanted = sum(float((dense(view, g, len(parts)) ** 2).sum()) for view in views)
        assert float(found.held[g]) == pytest.approx(wanted, rel=1e-3, abs=1e-5)
    twice, _ = solve_colors(found, shots, FEW)
    np.testing.assert_allclose(twice.held, 2 * found.held, rtol=1e-5)


@pytest.mark.parametrize("tint", [(0.1, 0.0, -0.1), (-0.06, 0.1, 0.04)])
def test_one_batch_after_the_other_is_near_all_at_once(
    parts: Parts, shots: Shots, tint: tuple[float, float, float]
) -> None:
    """Batches of other tints, which say different things: nearer than where earlier ones are forgotten."""
    steady = replace(FEW, min_gain=1.0, max_gain=1.0)
    sides = np.array([1, -1, 1, -1, 1, -1], np.float32)[:, None, None, None]
    images = 0.6 * shots.images + 0.2 + sides * np.array(tint, np.float32)
    tinted = Shots(images, shots.cameras)
    joint, _ = solve_colors(parts, tinted, steady)
    after = forgetful = parts
    for batch in (some(tinted, 0, 2, 4), some(tinted, 1, 3, 5)):
        after, report = solve_colors(after, batch, steady)
        assert report.accepted
        forgetful, _ = solve_colors(replace(forgetful, held=torch.zeros_like(parts.held)), batch, steady)
    assert rms(after.solved, joint.solved) < 0.8 * rms(forgetful.solved, joint.solved)
    assert rms(after.solved, joint.solved) < 0.7 * rms(joint.solved, parts.solved)
    np.testing.assert_allclose(after.held, joint.held, rtol=1e-4, atol=1e-4)


def test_the_threads_do_not_matter(parts: Parts, shots: Shots) -> None:
    from gsmerge.runtime.threads import use_threads

    found = []
    for threads in (1, 3):
        with use_threads(threads):
            found.append(solve_colors(parts, shots, FEW)[0])
    assert torch.equal(found[0].solved, found[1].solved)
    assert torch.equal(found[0].held, found[1].held)


def test_views_that_see_nothing_say_nothing(parts: Parts, shots: Shots) -> None:
    away = shots.cameras[:1]
    turn = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))
    away = replace(away, viewmats=turn @ away.viewmats)
    found, report = solve_colors(parts, Shots(shots.images[:1], away), FEW)
    assert not report.accepted
    assert torch.equal(found.solved, parts.solved)
    assert torch.equal(found.held, parts.held)
