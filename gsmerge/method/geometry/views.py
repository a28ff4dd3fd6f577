"""Choose which views of a scene are used, held out and scored, and select the cameras and Gaussians of chosen views.

Views are held out as in the paper (supplement A, "View sampling").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from gsmerge.types import PER_PIXEL, Cameras, Pixels, SceneT

MAX_SCORED_VIEWS = 24  # largest number of scored views if a decision depends on the score
# Largest number of scored views if only the report needs the score. On fifteen captures, the gain on samples of six
# views differs from that on all whole photos by .31 dB (rms); with eight by .33, with four by .67, with three by .72
REPORT_VIEWS = 6
BY_VIEW = ("cameras", "large_photos", "empty", *PER_PIXEL)  # fields of a scene that have an entry for each view


def even_views(num_views: int, count: int) -> list[int]:
    """Return ``count`` view ids at equal intervals, with the first and the last; the middle id for ``count = 1``."""
    if not 1 <= count <= num_views:
        raise ValueError(f"views: expected 1 to {num_views}, got {count}")
    if count == 1:
        return [(num_views - 1) // 2]
    return [round(i * (num_views - 1) / (count - 1)) for i in range(count)]


def scored_views(num_views: int) -> list[int]:
    """Return the ids of the views on which a scene is scored: all views, or ``MAX_SCORED_VIEWS`` evenly spaced views.

    The limit saves time, because the unmerged input is rendered in each scored view.
    """
    return even_views(num_views, min(num_views, MAX_SCORED_VIEWS))


def pick_views(num_views: int, max_count: int) -> list[int]:
    """Return at most ``max_count`` evenly spread view ids, without the first and the last view if possible."""
    count = min(num_views, max_count)
    return [int((i + 0.5) * num_views / count) for i in range(count)]


def midpoint_views(contexts: Sequence[float], candidates: Sequence[float]) -> list[int]:
    """Return the index of the candidate nearest to the middle of each two consecutive ``contexts``.

    Contexts and candidates are positions along the capture. If no candidate lies between two contexts, these contexts
    are left out.
    """
    midpoints = []
    for low, high in pairwise(sorted(contexts)):
        inside = [i for i, position in enumerate(candidates) if low < position < high]
        if inside:
            midpoints.append(min(inside, key=lambda i: (abs(candidates[i] - (low + high) / 2), candidates[i])))
    return midpoints


def camera_kinds(cameras: Cameras) -> np.ndarray:
    """Number cameras ``[c]`` from 0 on; cameras with equal poses and intrinsics share a number."""
    rows = np.concatenate([cameras.viewmats.reshape(-1, 16), cameras.Ks.reshape(-1, 9)], 1)
    numbers = [tuple(row) for row in rows.tolist()]
    kinds = {kind: i for i, kind in enumerate(sorted(set(numbers)))}
    return np.array([kinds[kind] for kind in numbers], np.int64)


def subset(scene: SceneT, view_ids: Sequence[int]) -> SceneT:
    """Return the scene with only the views ``view_ids``.

    If each Gaussian belongs to one view, only the Gaussians of ``view_ids`` stay. If views share Gaussians, all
    Gaussians stay, and their pixels are unknown.
    """
    ids = list(view_ids)
    fields = {name: array[ids] for name, array in vars(scene).items() if name in BY_VIEW and array is not None}
    fields["names"] = tuple(scene.names[i] for i in ids)
    fields["pixels"] = None
    if scene.has_own_pixels:
        rows, fields["pixels"] = scene.get_pixels().select(ids)
        fields["gaussians"] = scene.gaussians[rows]
        fields["filled"] = None if scene.filled is None else scene.filled[rows]
    return replace(scene, **fields)


def take_rows(scene: SceneT, rows: np.ndarray) -> SceneT:
    """Return the scene with only the Gaussians ``rows [m]``, ascending; pixels of other Gaussians show no Gaussian."""
    filled = None if scene.filled is None else scene.filled[rows]
    reduced = replace(scene, gaussians=scene.gaussians[rows], filled=filled, pixels=None)
    if not scene.has_own_pixels:
        return reduced
    pixels = scene.get_pixels()
    new_rows = np.full(len(scene.gaussians), -1, np.int32)
    new_rows[rows] = np.arange(len(rows), dtype=np.int32)
    fronts = np.where(pixels.shown, new_rows[pixels.fronts], np.int32(-1))
    return replace(reduced, pixels=Pixels(pixels.homes[rows], fronts, own=True))


def in_float64(cameras: Cameras) -> Cameras:
    """Return cameras with matrices in float64."""
    return replace(cameras, viewmats=cameras.viewmats.astype(np.float64), Ks=cameras.Ks.astype(np.float64))


def resize_cameras(cameras: Cameras, width: int, height: int) -> Cameras:
    """Set the size of the cameras' images, and scale their intrinsics to match."""
    scale = np.array([width / cameras.width, height / cameras.height, 1.0], cameras.Ks.dtype)
    return replace(cameras, Ks=cameras.Ks * scale[:, None], width=width, height=height)


def concat_cameras(first: Cameras, second: Cameras) -> Cameras:
    """Concatenate cameras of one size, in float64."""
    viewmats = np.concatenate([first.viewmats, second.viewmats], dtype=np.float64)
    return replace(first, viewmats=viewmats, Ks=np.concatenate([first.Ks, second.Ks], dtype=np.float64))
