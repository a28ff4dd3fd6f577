"""Costs of drawing scenes: render time, Gaussians blended into a pixel, and frames until merging pays."""

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

NUM_VIEWS, REPEATS = 3, 3  # evenly spread views that are rendered, each so many times
MAX_REPEATED_SECONDS = 2.0  # what takes longer is rendered once


def measure_costs(
    scenes: Mapping[str, Gaussians],
    cameras: Cameras,
    zooms: Sequence[float],
    near: float,
    *,
    merge_seconds: Mapping[str, float] | None = None,
    threads: int | None = None,
) -> dict[str, dict[str, Any]]:
    """Measure the costs of drawing each scene.

    The scenes are drawn in turns, so that a machine that slows down slows all of them; scenes are compared with the
    first. A few of the ``cameras`` are drawn, at ``zooms`` times their own size. ``near`` is in world units;
    ``merge_seconds`` is the time that making a scene took, if known; ``threads`` None: all. Returns plain JSON types by
    name: ``overdraw``, Gaussians blended into a pixel; ``speeds`` by zoom: seconds per view, and for all scenes but the
    first ``speedup`` and ``break_even_frames``, next to ``merge_seconds``.
    """
    few = cameras[pick_views(len(cameras), NUM_VIEWS)]
    costs: dict[str, dict[str, Any]] = {
        name: {"overdraw": round(overdraw(gaussians, few, near), 3), "speeds": []} for name, gaussians in scenes.items()
    }
    with use_threads(threads) as used:
        for zoom in zooms:
            views = zoom_cameras(few, zoom)
            head = {"width": views.width, "height": views.height, "threads": used}
            for name, seconds in time_in_turns(scenes, views, near).items():
                costs[name]["speeds"].append({**head, "seconds": round(seconds, 6)})
    first, *others = scenes
    for name in others:
        costs[name]["merge_seconds"] = merge = (merge_seconds or {}).get(name)
        for base, speed in zip(costs[first]["speeds"], costs[name]["speeds"], strict=True):
            before, after = base["seconds"], speed["seconds"]
            speed["speedup"] = before / after
            # Frames after which merging has saved its own time (paper, supplement: timing)
            speed["break_even_frames"] = None if merge is None or after >= before else merge / (before - after)
    return costs


def time_in_turns(scenes: Mapping[str, Gaussians], views: Cameras, near: float) -> dict[str, float]:
    """Measure the seconds per view that drawing each scene takes, at best of a few turns.

    The scenes are drawn one after the other and again, so that a machine that slows down slows all of them. ``views``
    are few; ``near`` is in the scenes' units.
    """
    shortest = {name: np.full(len(views), np.inf) for name in scenes}
    for gaussians in scenes.values():  # fills caches
        time_render(gaussians, views[[0]], near)
    for turn in range(REPEATS):
        for name, gaussians in scenes.items():
            if turn and shortest[name].max() > MAX_REPEATED_SECONDS:
                continue
            for view in range(len(views)):
                shortest[name][view] = min(shortest[name][view], time_render(gaussians, views[[view]], near))
    return {name: float(seconds.mean()) for name, seconds in shortest.items()}


def time_render(gaussians: Gaussians, view: Cameras, near: float) -> float:
    """Measure the seconds that rendering a view takes."""
    start = time.perf_counter()
    render(gaussians, view, near=near)
    return time.perf_counter() - start


def overdraw(gaussians: Gaussians, cameras: Cameras, near: float) -> float:
    """Measure the mean number of Gaussians blended into a pixel, which determines the render time."""
    splats, entries = make_splats(gaussians), 0
    viewmats, Ks = cameras.viewmats.astype(np.float64), cameras.Ks.astype(np.float64)
    for view in range(len(cameras)):
        tiled = tile_view(splats, viewmats[view], Ks[view], cameras.width, cameras.height, near=near)
        entries += len(view_weights(tiled).lanes)
    return entries / max(len(cameras) * cameras.width * cameras.height, 1)
