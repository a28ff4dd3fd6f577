"""Find views of a scene that repeat others in every pixel, so that each counts once."""

from __future__ import annotations

import numpy as np

from gsmerge.method.geometry.views import camera_kinds, subset
from gsmerge.types import Scene


def without_repeats(scene: Scene) -> tuple[Scene, list[int], list[str]]:
    """Return a scene without repeated views, every input view's index in this scene, and notes on repeated views."""
    views, repeated = distinct_views(scene)
    count = len(scene) - len(views)
    if not count:
        return scene, repeated, []
    one = "1 view repeats another in every pixel and counts once"
    notes = [one if count == 1 else f"{count} views repeat others in every pixel and count once"]
    return subset(scene, views), repeated, notes


def distinct_views(scene: Scene) -> tuple[list[int], list[int]]:
    """Return the ids of the views that repeat no earlier view, and the index of every view in the list of these ids.

    Two views are equal if their cameras, photos, masks and Gaussians are equal.
    """
    kinds = camera_kinds(scene.cameras)
    distinct = list[int]()
    indices = list[int]()
    for view, kind in enumerate(kinds):
        equal = (
            i for i, earlier in enumerate(distinct) if kinds[earlier] == kind and _equal_views(scene, earlier, view)
        )
        indices.append(next(equal, len(distinct)))
        if indices[-1] == len(distinct):
            distinct.append(view)
    return distinct, indices


def _equal_views(scene: Scene, first: int, second: int) -> bool:
    """Return whether two views of one camera have the same photo, mask, importance and Gaussians."""
    for pictures in (scene.images, scene.masks, scene.importance):
        if pictures is not None and not np.array_equal(pictures[first], pictures[second]):
            return False
    if not scene.has_own_pixels:
        return True
    a, b = (scene.get_pixels().rows_of_views[view] for view in (first, second))
    return all(np.array_equal(values[a], values[b]) for values in vars(scene.gaussians).values())
