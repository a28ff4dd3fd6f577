"""Render time of scenes, and how many Gaussians are blended into a pixel."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmerge.render import plan_view, prepare, render
from gsmerge.render.weights import view_weights
from gsmerge.runtime.threads import use_threads
from gsmerge.types import Cameras, Gaussians
from gsmerge.views import pick_views

NUM_VIEWS, REPEATS = 3, 3  # evenly spread views that are rendered, each so many times
MAX_REPEATED_SECONDS = 2.0  # what takes longer is rendered once


@dataclass(frozen=True)
class Speed:
    """Time to render one view of a scene."""

    device: str  # "cpu" or "cuda"
    width: int  # of the picture, pixels
    height: int  # the same
    threads: int  # processor threads that rendered it; 0 on a GPU
    seconds: float  # mean over some views of the shortest of some repetitions


def resized(cameras: Cameras, long_side: int) -> Cameras:
    """The same cameras with images whose longer side has ``long_side`` pixels."""
    factor = long_side / max(cameras.width, cameras.height)
    size = max(1, round(cameras.width * factor)), max(1, round(cameras.height * factor))
    scale = np.array([size[0] / cameras.width, size[1] / cameras.height, 1.0], cameras.Ks.dtype)
    return replace(cameras, Ks=cameras.Ks * scale[:, None], width=size[0], height=size[1])


def measure_speeds(
    scenes: Mapping[str, Gaussians],
    cameras: Cameras,
    long_sides: Sequence[int],
    near: float,
    *,
    threads: int | None = None,
) -> dict[str, tuple[Speed, ...]]:
    """Render scenes from a few of the views at several sizes, also with CUDA where it can be used.

    The scenes take turns, so that a machine that slows down slows all of them. ``long_sides`` are pixels along the
    longer side, ``near`` is in world units.
    """
    from gsmerge.gpu import cuda_problem

    few = cameras[pick_views(len(cameras), NUM_VIEWS)]
    speeds: dict[str, list[Speed]] = {name: [] for name in scenes}
    with use_threads(threads) as used:
        for device in ("cpu",) if cuda_problem() else ("cpu", "cuda"):
            on_cpu = device == "cpu"
            placed = scenes if on_cpu else {name: gaussians.to(device) for name, gaussians in scenes.items()}
            for side in long_sides:
                views = resized(few, side)
                for name, seconds in _time_in_turns(placed, views if on_cpu else views.to(device), near).items():
                    count = used if on_cpu else 0
                    speeds[name].append(Speed(device, views.width, views.height, count, seconds))
    return {name: tuple(measured) for name, measured in speeds.items()}


def _time_in_turns(scenes: Mapping[str, Gaussians], views: Cameras, near: float) -> dict[str, float]:
    """Seconds per view of each scene, one after the other and again."""
    shortest = {name: np.full(len(views), np.inf) for name in scenes}
    for gaussians in scenes.values():  # compiles, and fills caches
        time_render(gaussians, views[[0]], near)
    for turn in range(REPEATS):
        for name, gaussians in scenes.items():
            if turn and shortest[name].max() > MAX_REPEATED_SECONDS:
                continue
            for view in range(len(views)):
                shortest[name][view] = min(shortest[name][view], time_render(gaussians, views[[view]], near))
    return {name: float(seconds.mean()) for name, seconds in shortest.items()}


def time_render(gaussians: Gaussians, view: Cameras, near: float) -> float:
    """Seconds to render a view."""
    start = time.perf_counter()
    image = render(gaussians, view, near=near).images
    if not isinstance(image, np.ndarray) and image.is_cuda:
        import torch

        torch.cuda.synchronize()
    return time.perf_counter() - start


def overdraw(gaussians: Gaussians, cameras: Cameras, near: float) -> float:
    """Gaussians blended into a pixel, on average over some of the views: what render time depends on."""
    splats, entries, pixels = prepare(gaussians), 0, 0
    viewmats, Ks = cameras.viewmats.astype(np.float64), cameras.Ks.astype(np.float64)
    for view in pick_views(len(cameras), NUM_VIEWS):
        plan = plan_view(splats, viewmats[view], Ks[view], cameras.width, cameras.height, near=near)
        entries += len(view_weights(plan).lanes)
        pixels += cameras.width * cameras.height
    return entries / max(pixels, 1)
