"""Choose views: given, held out (the paper's rule, supplement A, "View sampling"), and scored; select their cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from gsmerge.types import PER_PIXEL, Cameras, Pixels, Scene, SceneT

MAX_SCORED_VIEWS = 24  # most scored views of a scene if a decision depends on the score
REPORT_VIEWS = 4  # most scored views if only the report needs the score
BY_VIEW = ("cameras", "large_photos", "empty", *PER_PIXEL)  # fields of a scene with one part for each view


def even_views(num_views: int, count: int) -> list[int]:
    """Return ``count`` view ids at equal intervals, first and last included (the middle one for ``count = 1``)."""
    if not 1 <= count <= num_views:
        raise ValueError(f"views: expected 1 to {num_views}, got {count}")
    if count == 1:
        return [(num_views - 1) // 2]
    return [round(i * (num_views - 1) / (count - 1)) for i in range(count)]


def scored_views(num_views: int) -> list[int]:
    """Return view ids for scoring a whole scene: all, or ``MAX_SCORED_VIEWS`` evenly spaced views.

    The time to render the unmerged input is proportional to views and Gaussians; with all views it would be most of a
    run.
    """
    return even_views(num_views, min(num_views, MAX_SCORED_VIEWS))


def pick_views(num_views: int, most: int) -> list[int]:
    """Return at most ``most`` evenly spread view ids, if possible without the first and the last view."""
    count = min(num_views, most)
    return [int((i + 0.5) * num_views / count) for i in range(count)]


def midpoint_views(contexts: Sequence[float], candidates: Sequence[float]) -> list[int]:
    """Return, for each pair of consecutive ``contexts``, the index of the candidate nearest to their middle, if any."""
    chosen = []
    for low, high in pairwise(sorted(contexts)):
        inside = [i for i, place in enumerate(candidates) if low < place < high]
        if inside:
            chosen.append(min(inside, key=lambda i: (abs(candidates[i] - (low + high) / 2), candidates[i])))
    return chosen


def camera_kinds(cameras: Cameras) -> np.ndarray:
    """Number the cameras ``[c]`` from 0, with equal numbers for equal poses and intrinsics."""
    rows = np.concatenate([cameras.viewmats.reshape(-1, 16), cameras.Ks.reshape(-1, 9)], 1)
    return np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1)


def distinct_views(scene: Scene) -> tuple[list[int], list[int]]:
    """Return the ids of views that repeat no earlier view and, for every view, its index among these.

    A view repeats another if camera, photo and Gaussians are equal; it then has the index of that view.
    """
    kinds = camera_kinds(scene.cameras)
    distinct, places = list[int](), list[int]()
    for view, kind in enumerate(kinds):
        equal = (i for i, other in enumerate(distinct) if kinds[other] == kind and _equal_views(scene, other, view))
        places.append(next(equal, len(distinct)))
        if places[-1] == len(distinct):
            distinct.append(view)
    return distinct, places


def _equal_views(scene: Scene, first: int, second: int) -> bool:
    """Return whether two views of one camera have the same photo, mask, importance and Gaussians."""
    for pictures in (scene.images, scene.masks, scene.importance):
        if pictures is not None and not np.array_equal(pictures[first], pictures[second]):
            return False
    if not scene.has_own_pixels:
        return True
    a, b = (scene.get_pixels().rows_of_views[view] for view in (first, second))
    return all(np.array_equal(values[a], values[b]) for values in vars(scene.gaussians).values())


def subset(scene: SceneT, view_ids: Sequence[int]) -> SceneT:
    """Return the scene with only the views ``view_ids``, and only their Gaussians if views have Gaussians of their own.

    Otherwise all Gaussians stay, and their pixels are unknown.
    """
    ids = list(view_ids)
    parts = {name: value[ids] for name, value in vars(scene).items() if name in BY_VIEW and value is not None}
    parts["names"] = tuple(scene.names[i] for i in ids)
    parts["pixels"] = None
    if scene.has_own_pixels:
        rows, parts["pixels"] = scene.get_pixels().select(ids)
        parts["gaussians"] = scene.gaussians[rows]
        parts["filled"] = None if scene.filled is None else scene.filled[rows]
    return replace(scene, **parts)


def take_rows(scene: SceneT, rows: np.ndarray) -> SceneT:
    """Return the scene with only the Gaussians ``rows [m]``, ascending; pixels of other Gaussians show none."""
    filled = None if scene.filled is None else scene.filled[rows]
    part = replace(scene, gaussians=scene.gaussians[rows], filled=filled, pixels=None)
    if not scene.has_own_pixels:
        return part
    pixels, numbers = scene.get_pixels(), np.full(len(scene.gaussians), -1, np.int32)
    numbers[rows] = np.arange(len(rows), dtype=np.int32)
    fronts = np.where(pixels.shown, numbers[pixels.fronts], np.int32(-1))
    return replace(part, pixels=Pixels(pixels.homes[rows], fronts, own=True))


def in_float64(cameras: Cameras) -> Cameras:
    """Return cameras with matrices in float64."""
    return replace(cameras, viewmats=cameras.viewmats.astype(np.float64), Ks=cameras.Ks.astype(np.float64))


def resize_cameras(cameras: Cameras, width: int, height: int) -> Cameras:
    """Resize the cameras' images, and scale their intrinsics to match."""
    scale = np.array([width / cameras.width, height / cameras.height, 1.0], cameras.Ks.dtype)
    return replace(cameras, Ks=cameras.Ks * scale[:, None], width=width, height=height)


def concat_cameras(first: Cameras, second: Cameras) -> Cameras:
    """Concatenate cameras of one size, in float64."""
    viewmats = np.concatenate([first.viewmats, second.viewmats], dtype=np.float64)
    return replace(first, viewmats=viewmats, Ks=np.concatenate([first.Ks, second.Ks], dtype=np.float64))
