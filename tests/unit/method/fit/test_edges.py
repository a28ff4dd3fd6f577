"""Gaussians of a fit are cut and split at the edges of its photos."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import Gaussians
from gsmerge.method.fit.edges import Edges, cut_state, find_edges, split_at_edges
from gsmerge.method.fit.fit_state import FitState, gaussians_of, start_state
from gsmerge.method.fit.full import fit_full
from gsmerge.method.geometry.transforms import project
from gsmerge.method.kernels.gaussians.optimise import cut_at_edges
from gsmerge.method.raster import render
from gsmerge.method.raster.photos import Photos
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.fit import FitOptions
from gsmerge.types import Cameras

Pair = tuple[Photos, Photos]


def with_wide(truth: Gaussians) -> Gaussians:
    """Return the same, with every twentieth Gaussian eight times as large."""
    wide = np.arange(0, len(truth), 20)
    scales = truth.scales.copy()
    scales[wide] *= 8
    return replace(truth, scales=scales)


def edges_of(photos: Photos, margin: float) -> Edges:
    """Find edges that are moved out by a margin in pixels."""
    cameras = Cameras(photos.viewmats, photos.Ks, photos.width, photos.height)
    return find_edges(cameras, round(4 * len(photos) * photos.width * photos.height / margin**2))


def lost_beyond(gaussians: Gaussians, edges: Edges) -> np.ndarray:
    """Return the sum of the squared scales of each Gaussian across edges that a cut takes away."""
    means, is_cut, covars = gaussians.means.copy(), np.zeros(len(gaussians), np.uint8), np.zeros((len(gaussians), 3, 3))
    planes = edges.normals, edges.offsets
    cut_at_edges(gaussians.quats, gaussians.scales, *planes, 0, len(gaussians), means, covars, is_cut)
    lost = (gaussians.scales.astype(np.float64) ** 2).sum(1) - np.trace(covars, axis1=1, axis2=2)
    return lost[is_cut > 0]


def test_edges_are_the_bounds_of_what_photos_show(photos: Pair) -> None:
    margin, half = 1.5, photos[1]
    edges = edges_of(half, margin)
    points = np.random.default_rng(1).normal(0, 3, (500, 3))
    cameras = Cameras(half.viewmats, half.Ks, half.width, half.height)
    pixels, depths = project(points, cameras)
    size = np.array([half.width, half.height])
    shown = ((pixels > -margin) & (pixels < size + margin)).all(2) & (depths > 0)
    inside = (edges.offsets[:, None] - np.einsum("vpi,ni->vnp", edges.normals, points) > 0).all(2)
    np.testing.assert_array_equal(inside, shown)
    assert 0.02 < shown.mean() < 0.9


def test_gaussians_that_cross_the_edges_are_cut_there(truth: Gaussians, photos: Pair) -> None:
    wide, edges = with_wide(truth), edges_of(photos[1], 4.0)
    state = start_state(wide)
    cut_state(state, edges)
    moved = (state.splats.means != wide.means).any(1)
    assert 5 < moved.sum() < len(wide)
    after = replace(wide, means=state.splats.means, quats=state.splats.quats, scales=state.splats.scales)
    assert 3 * lost_beyond(after, edges).sum() < lost_beyond(wide, edges).sum()
    np.testing.assert_array_equal(state.x[:, :3], state.splats.means)
    np.testing.assert_array_equal(state.x0[moved, :3], state.x[moved, :3])
    np.testing.assert_array_equal(state.x0[moved, 3:6], np.sort(start_state(wide).x[moved, 3:6], 1))
    np.testing.assert_array_equal(state.x[~moved], start_state(wide).x[~moved])


def test_cutting_keeps_fixed_gaussians_with_the_least_sizes_of_others(truth: Gaussians, photos: Pair) -> None:
    state = start_state(with_wide(truth))
    state.fixed[::2] = True
    state.fixed[20] = False  # a wide one
    state.min_sizes[:] = state.x[:, 3:6].max(1)
    before, free = state.x.copy(), ~state.fixed
    cut_state(state, edges_of(photos[1], 4.0))
    np.testing.assert_array_equal(state.x[~free], before[~free])
    assert not np.array_equal(state.x[free], before[free])
    assert (state.x[:, 3:6].max(1) >= state.min_sizes).all()


def across_an_edge(opacity: float) -> tuple[FitState, Edges]:
    """Make a disc of ten pixels (sigma), its middle two pixels inside a photo of 48 pixels, and a small one inside."""
    cameras, x = scenes.arc(1), -22.0 * 3 / 48
    means = np.array([[x, 0, 3], [0, 0, 3]], np.float32)
    scales = np.array([[0.625, 0.625, 0.001], [0.02, 0.02, 0.02]], np.float32)
    quats, sh0 = np.tile(np.float32([1, 0, 0, 0]), (2, 1)), np.zeros((2, 1, 3), np.float32)
    opacities = np.array([opacity, 0.9], np.float32)
    return start_state(Gaussians(means, quats, scales, opacities, sh0, np.zeros((2, 0, 3), np.float32))), find_edges(
        cameras, 48 * 36 * 4
    )


def opacities_of(state: FitState) -> np.ndarray:
    """Return opacities ``[96]`` along the middle row of a picture that is twice as wide as the photo."""
    cameras = scenes.arc(1)
    wide = replace(cameras, Ks=cameras.Ks + np.array([[0, 0, 24], [0, 0, 0], [0, 0, 0]]), width=96)
    return np.asarray(render(gaussians_of(state.x, state.splats.shN), wide).alphas[0, 18, :, 0])


def test_a_large_gaussian_is_split_until_its_rim_is_narrow() -> None:
    state, edges = across_an_edge(0.95)
    before, after = opacities_of(state), opacities_of(split_at_edges(state, edges, 100))
    assert before[:20].max() > 0.5  # it reaches beyond the photo, whose edge is at 24, moved out by one pixel
    assert after[:20].max() < 0.05
    assert after[25:30].min() > 0.9
    assert (after[25:] > before[25:] - 0.05).all()  # halves overlap, so no gap opens


@pytest.mark.parametrize("most", [2, 3, 6])
def test_splits_stay_within_the_most_gaussians(most: int) -> None:
    state, edges = across_an_edge(0.95)
    split = split_at_edges(state, edges, most)
    assert len(split.x) <= most
    assert set(split.origins) <= {0, 1}
    np.testing.assert_array_equal(split.x[split.origins == 1], state.x[1:])


def test_a_faint_gaussian_across_an_edge_is_not_split() -> None:
    state, edges = across_an_edge(0.15)
    np.testing.assert_array_equal(split_at_edges(state, edges, 100).x, state.x)


def test_splits_that_show_the_photos_worse_are_not_taken(
    truth: Gaussians, photos: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = list[int]()

    def lose(state: FitState, *_: object) -> FitState:
        calls.append(len(state.x))
        return state[np.arange(0)]

    monkeypatch.setattr("gsmerge.method.fit.full.split_at_edges", lose)
    run = scenes.run_for(photos, FitOptions(fit_steps=150), len(truth), edges=edges_of(photos[1], 2.0))
    fitted, _ = fit_full(scenes.spoil(with_wide(truth)), run)
    assert calls == [len(fitted)]


def test_the_number_of_threads_does_not_change_a_cut(
    truth: Gaussians, photos: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsmerge.method.fit.edges.ROWS", 7)

    def cut(threads: int) -> FitState:
        state = start_state(with_wide(truth))
        with use_threads(threads):
            cut_state(state, edges_of(photos[1], 4.0))
        return state

    np.testing.assert_array_equal(cut(1).x, cut(3).x)


@pytest.mark.slow
def test_a_long_fit_with_edges_reaches_less_beyond_its_photos(truth: Gaussians, photos: Pair) -> None:
    """Of one seed few Gaussians decide, so that four are taken, and lengths in place of their squares."""
    edges, reach = edges_of(photos[1], 2.0), np.zeros(2)
    for seed in range(4):
        start = scenes.spoil(with_wide(truth), seed=seed)
        for i, some in enumerate((edges, None)):
            run = scenes.run_for(photos, FitOptions(fit_steps=150), len(start), seed=seed, edges=some)
            reach[i] += np.sqrt(lost_beyond(fit_full(start, run)[0], edges)).sum()
    assert 1.3 * reach[0] < reach[1]
