"""Which views go in, which are held out (the paper's rule, supplement A, "View sampling"), and which are scored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from gsmerge.types import Scene, grid_ids

MAX_SCORED_VIEWS = 24  # views by which whole scenes are judged where something depends on it
REPORT_VIEWS = 4  # views that input and result are scored on for the report alone


def even_views(num_views: int, count: int) -> list[int]:
    """``count`` of the views at equal intervals, first and last among them (the middle one for ``count = 1``).

    Raises:
        ValueError: If there are not as many.
    """
    if not 1 <= count <= num_views:
        raise ValueError(f"views: expected 1 to {num_views}, got {count}")
    if count == 1:
        return [(num_views - 1) // 2]
    return [round(i * (num_views - 1) / (count - 1)) for i in range(count)]


def scored_views(num_views: int) -> list[int]:
    """The views that whole scenes are judged by: all, of many evenly spread ones.

    Rendering the unmerged input costs as many views as Gaussians, so with all of many views it would be most of a run.
    """
    return even_views(num_views, min(num_views, MAX_SCORED_VIEWS))


def report_views(num_views: int) -> list[int]:
    """The views that input and result are scored on where nothing but the report needs the numbers."""
    return pick_views(num_views, REPORT_VIEWS)


def pick_views(num_views: int, most: int) -> list[int]:
    """At most ``most`` view ids, evenly spread and without the first and last where there are enough."""
    count = min(num_views, most)
    return [int((i + 0.5) * num_views / count) for i in range(count)]


def midpoint_views(contexts: Sequence[float], candidates: Sequence[float]) -> list[int]:
    """For each two consecutive contexts the candidate nearest the middle between them.

    Args:
        contexts: Places along the trajectory, in any order.
        candidates: Places of the views that may be targets.

    Returns:
        Indices of candidates, none twice, in the order of the trajectory; a gap with no candidate gives none.
    """
    chosen = []
    for low, high in pairwise(sorted(contexts)):
        inside = [i for i, place in enumerate(candidates) if low < place < high]
        if inside:
            chosen.append(min(inside, key=lambda i: (abs(candidates[i] - (low + high) / 2), candidates[i])))
    return chosen


def distinct_views(scene: Scene) -> tuple[list[int], list[int]]:
    """The views without those that repeat an earlier one: the same camera, the same photo, the same Gaussians.

    Returns:
        Their numbers, and of every view the place of what it repeats among them, or its own.
    """
    cameras = np.concatenate([scene.cameras.viewmats.reshape(-1, 16), scene.cameras.Ks.reshape(-1, 9)], 1)
    _, firsts = np.unique(cameras, axis=0, return_inverse=True)
    kept, places = list[int](), list[int]()
    for view, kind in enumerate(firsts.reshape(-1)):
        equal = (i for i, one in enumerate(kept) if firsts.reshape(-1)[one] == kind and _equal_views(scene, one, view))
        places.append(next(equal, len(kept)))
        if places[-1] == len(kept):
            kept.append(view)
    return kept, places


def _equal_views(scene: Scene, one: int, other: int) -> bool:
    """Whether two views of one camera have the same photo and the same Gaussians."""
    if scene.images is not None and not np.array_equal(scene.images[one], scene.images[other]):
        return False
    if not scene.aligned:
        return True
    size = scene.pixels_per_view
    a, b = (vars(scene.gaussians[view * size : (view + 1) * size]) for view in (one, other))
    return all(np.array_equal(a[name], b[name]) for name in a)


def subset(scene: Scene, view_ids: Sequence[int]) -> Scene:
    """The scene as if only some of its views had been given: their Gaussians, cameras and photos.

    Unaligned Gaussians belong to no view, and all stay.
    """
    ids = list(view_ids)
    images = None if scene.images is None else scene.images[ids]
    names = tuple(scene.names[i] for i in ids)
    large = None if scene.large_photos is None else scene.large_photos[ids]
    if not scene.aligned:
        return replace(scene, cameras=scene.cameras[ids], images=images, names=names, large_photos=large)
    size = scene.pixels_per_view
    rows = (np.asarray(ids, np.int64)[:, None] * size + np.arange(size)).reshape(-1)
    return replace(
        scene,
        gaussians=scene.gaussians[rows],
        cameras=scene.cameras[ids],
        images=images,
        pixel_ids=grid_ids(scene.valid[ids]),
        names=names,
        missing=None if scene.missing is None else scene.missing[ids],
        large_photos=large,
    )
