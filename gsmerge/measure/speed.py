"""Measure the costs of drawing scenes: render time, Gaussians blended per pixel, and frames until merging pays."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gsmerge.facts.views import pick_views
from gsmerge.measure.sizes import zoom_cameras
from gsmerge.raster import make_splats, render, tile_view
from gsmerge.raster.weights import view_weights
from gsmerge.runtime.threads import use_threads
from gsmerge.types import Cameras, Gaussians

NUM_VIEWS, REPEATS = 3, 3  # number of evenly spread views, and how often each is rendered
MAX_REPEATED_SECONDS = 2.0  # views that take longer are rendered once


def measure_costs(
    scenes: Mapping[str, Gaussians],
    cameras: Cameras,
    zooms: Sequence[float],
    near: float,
    *,
    threads: int | None = None,
) -> dict[str, dict[str, Any]]:
    """Measure the costs of drawing each scene.

    A few of the ``cameras`` are drawn at ``zooms`` times their own size. The scenes are drawn in turns, so that a
    machine that slows down slows all of them. ``near``: near plane, in world units. ``threads`` None: all
    processors.

    Returns plain JSON types by name: ``overdraw``, the Gaussians blended per pixel, and ``speeds``, for each zoom the
    seconds per view. All scenes but the first also have in ``speeds`` the ``speedup`` against the first scene.
    """
    sampled = cameras[pick_views(len(cameras), NUM_VIEWS)]
    costs: dict[str, dict[str, Any]] = {
        name: {"overdraw": round(overdraw(gaussians, sampled, near), 3), "speeds": []}
        for name, gaussians in scenes.items()
    }
    with use_threads(threads) as used:
        for zoom in zooms:
            views = zoom_cameras(sampled, zoom)
            head = {"width": views.width, "height": views.height, "threads": used}
            for name, seconds in time_in_turns(scenes, views, near).items():
                costs[name]["speeds"].append({**head, "seconds": round(seconds, 6)})
    baseline, *results = scenes
    for name in results:
        for base_speed, speed in zip(costs[baseline]["speeds"], costs[name]["speeds"], strict=True):
            speed["speedup"] = base_speed["seconds"] / speed["seconds"]
    return costs


def time_in_turns(scenes: Mapping[str, Gaussians], views: Cameras, near: float) -> dict[str, float]:
    """Measure the seconds per view of drawing each scene, the least of ``REPEATS`` rounds.

    Each round draws all scenes one after the other, so that a machine that slows down slows all of them. ``near``: near
    plane, in the units of the scenes.
    """
    shortest = {name: np.full(len(views), np.inf) for name in scenes}
    for gaussians in scenes.values():  # the first render fills caches
        time_render(gaussians, views[[0]], near)
    for round_number in range(REPEATS):
        for name, gaussians in scenes.items():
            if round_number and shortest[name].max() > MAX_REPEATED_SECONDS:
                continue
            for view in range(len(views)):
                shortest[name][view] = min(shortest[name][view], time_render(gaussians, views[[view]], near))
    return {name: float(seconds.mean()) for name, seconds in shortest.items()}


def time_render(gaussians: Gaussians, view: Cameras, near: float) -> float:
    """Measure the seconds of rendering a view."""
    start = time.perf_counter()
    render(gaussians, view, near=near)
    return time.perf_counter() - start


def overdraw(gaussians: Gaussians, cameras: Cameras, near: float) -> float:
    """Measure the mean number of Gaussians blended per pixel, which determines the render time."""
    splats, entries = make_splats(gaussians), 0
    viewmats, Ks = cameras.viewmats.astype(np.float64), cameras.Ks.astype(np.float64)
    for view in range(len(cameras)):
        tiled = tile_view(splats, viewmats[view], Ks[view], cameras.width, cameras.height, near=near)
        entries += len(view_weights(tiled).lanes)
    return entries / max(len(cameras) * cameras.width * cameras.height, 1)
