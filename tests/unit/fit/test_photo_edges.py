"""Cutting the Gaussians of a fit at the edges of its photos."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import Gaussians, Scene
from gsmerge.fit.edges import cut_state, photo_edges
from gsmerge.fit.fit_state import FitState, start_state
from gsmerge.fit.full import fit_full
from gsmerge.geometry import project
from gsmerge.raster import contributions, make_splats, tile_view
from gsmerge.raster.photos import Photos
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.fit import FitOptions
from gsmerge.types import Cameras

Pair = tuple[Photos, Photos]


def with_wide(truth: Gaussians) -> Gaussians:
    """The same, with every twentieth Gaussian eight times as large."""
    wide = np.arange(0, len(truth), 20)
    scales = truth.scales.copy()
    scales[wide] *= 8
    return replace(truth, scales=scales)


def wider(photos: Photos, by: float) -> Cameras:
    """The cameras of photos with so many times their width and height."""
    width, height = round(by * photos.width), round(by * photos.height)
    Ks = photos.Ks.copy()
    Ks[:, 0, 2] += (width - photos.width) / 2
    Ks[:, 1, 2] += (height - photos.height) / 2
    return Cameras(photos.viewmats, Ks, width, height)


def reach_beyond(gaussians: Gaussians, photos: Photos) -> float:
    """Mean opacity outside of all photos in pictures three times as wide."""
    cameras, sum_beyond, count = wider(photos, 3), 0.0, 0
    for view in range(len(photos)):
        tiled = tile_view(
            make_splats(gaussians), cameras.viewmats[view], cameras.Ks[view], cameras.width, cameras.height
        )
        weights = contributions(tiled)[0]
        sum_beyond += float(weights.sum())
        inside = tile_view(make_splats(gaussians), **photos.camera(view))
        sum_beyond -= float(contributions(inside)[0].sum())
        count += cameras.width * cameras.height - photos.width * photos.height
    return sum_beyond / count


def test_edges_bound_what_photos_show(photos: Pair) -> None:
    margin, half = 1.5, photos[1]
    edges = photo_edges(half, margin)
    points = np.random.default_rng(1).normal(0, 3, (500, 3))
    cameras = Cameras(half.viewmats, half.Ks, half.width, half.height)
    pixels, depths = project(points, cameras)
    size = np.array([half.width, half.height])
    shown = ((pixels > -margin) & (pixels < size + margin)).all(2) & (depths > 0)
    inside = (edges.offsets[:, None] - np.einsum("vpi,ni->vnp", edges.normals, points) > 0).all(2)
    np.testing.assert_array_equal(inside, shown)
    assert 0.02 < shown.mean() < 0.9


def test_what_crosses_the_edges_ends_there(truth: Gaussians, photos: Pair) -> None:
    wide = with_wide(truth)
    state = start_state(wide)
    cut_state(state, photos[1])
    moved = (state.splats.means != wide.means).any(1)
    assert 5 < moved.sum() < len(wide)
    after = replace(wide, means=state.splats.means, quats=state.splats.quats, scales=state.splats.scales)
    assert reach_beyond(after, photos[0]) < 0.6 * reach_beyond(wide, photos[0])
    np.testing.assert_array_equal(state.x[:, :3], state.splats.means)
    np.testing.assert_array_equal(state.x0[moved, :10], state.x[moved, :10])
    np.testing.assert_array_equal(state.x[~moved], start_state(wide).x[~moved])


def test_fixed_gaussians_and_least_sizes_stay(truth: Gaussians, photos: Pair) -> None:
    state = start_state(with_wide(truth))
    state.fixed[::2] = True
    state.fixed[20] = False  # a wide one
    state.min_sizes[:] = state.x[:, 3:6].max(1)
    before, free = state.x.copy(), ~state.fixed
    cut_state(state, photos[1])
    np.testing.assert_array_equal(state.x[~free], before[~free])
    assert not np.array_equal(state.x[free], before[free])
    assert (state.x[:, 3:6].max(1) >= state.min_sizes).all()


def test_threads_write_the_same(truth: Gaussians, photos: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsmerge.fit.edges.ROWS", 7)

    def cut(threads: int) -> FitState:
        state = start_state(with_wide(truth))
        with use_threads(threads):
            cut_state(state, photos[1])
        return state

    np.testing.assert_array_equal(cut(1).x, cut(3).x)


def test_a_fit_reaches_beyond_its_photos_only_where_asked(scene: Scene, truth: Gaussians, photos: Pair) -> None:
    start = scenes.spoil(with_wide(truth))
    run = {beyond: scenes.run_for(photos, FitOptions(fit_steps=60, beyond=beyond)) for beyond in (False, True)}
    results = {beyond: fit_full(start, one)[0] for beyond, one in run.items()}
    assert reach_beyond(results[False], photos[0]) < 0.6 * reach_beyond(results[True], photos[0])
