"""Choose between the depths of Gaussians and those of depth maps beside them, by what other views show.

Depth Anything 3 writes both. Its Gaussians take depth along z as distance along the ray, and add an offset.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.geometry import camera_centres, camera_depths, sh0_to_rgb
from gsmerge.kernels.gaussians.cross_view import COLUMNS, sum_cross_view
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Scene

_SAME = 0.02  # logarithm of two depths of one surface
_NEIGHBORS = 8  # nearest other views that are asked
_COLOR = 5.0  # of a vote, for each unit of colour, sRGB in [0, 1], that the other view's differs by
_CLEAR = 2.0  # times as many pixels must prefer the map for a view to be placed at it
_ALONE = 3.0  # votes by which a pixel differs from its view's choice


def choose_depths(scene: Scene, maps: np.ndarray, unit: float) -> Scene:
    """Place Gaussians of an aligned scene at the depths ``maps [v,h,w]`` where other views confirm these alone.

    ``unit``: that of the maps in the scene's; if nothing is confirmed, their median ratio to the Gaussians' depths is
    tried. Each view is asked as a whole, then each of its pixels. The scene itself is returned where nothing moves.
    """
    views = len(scene)
    viewmats, valid = scene.cameras.viewmats.astype(np.float64), scene.valid.reshape(views, -1)
    centres, means = camera_centres(viewmats)[:, None], scene.gaussians.means.astype(np.float64).reshape(views, -1, 3)
    depths, maps = camera_depths(means, viewmats[:, None]), maps.reshape(views, -1).astype(np.float64)
    usable = valid & (depths > 0) & (maps > 0) & np.isfinite(maps)
    ratios = np.where(usable, maps, 1) / np.where(usable, depths, 1)
    for scale in (unit, 1 / np.median(ratios[usable])) if views > 1 and usable.any() else ():
        factors = np.where(usable, ratios * scale, 1)[..., None]
        at_maps = centres + (means - centres) * factors
        chosen = _confirmed(scene, at_maps.astype(np.float32), usable & (np.abs(factors[..., 0] - 1) > _SAME))
        chosen &= usable
        if chosen.any():
            g, rows = scene.gaussians, chosen.reshape(-1)
            moved, scales = g.means.copy(), g.scales.copy()
            moved[rows] = at_maps[chosen]
            scales[rows] *= factors[chosen].astype(np.float32)
            return replace(scene, gaussians=replace(g, means=moved, scales=scales))
    return scene


def _confirmed(scene: Scene, at_maps: np.ndarray, differ: np.ndarray) -> np.ndarray:
    """Return where ``[v,p]`` other views confirm the points ``at_maps [v,p,3]``, not the Gaussians that ``differ``."""
    cameras, (views, pixels) = scene.cameras, differ.shape
    viewmats, Ks = (np.ascontiguousarray(array, np.float64) for array in (cameras.viewmats, cameras.Ks))
    shown = sh0_to_rgb(scene.gaussians.sh0) if scene.images is None else scene.images
    colors = np.ascontiguousarray(shown, np.float32).reshape(-1, 3)
    sources = [np.ascontiguousarray(points, np.float32).reshape(-1, 3) for points in (scene.gaussians.means, at_maps)]
    ids = np.where(scene.valid, np.arange(differ.size, dtype=np.int32).reshape(scene.valid.shape), -1)
    away = np.linalg.norm(camera_centres(viewmats)[:, None] - camera_centres(viewmats), axis=2)
    opaque = np.ones(differ.size, np.float32)

    def in_view(view: int) -> np.ndarray:
        rows = view * pixels + np.flatnonzero(differ[view])
        near = np.argsort(away[view] + np.where(np.arange(views) == view, np.inf, 0), kind="stable")[:_NEIGHBORS]
        near = near[near != view]
        support = np.zeros((2, len(rows), COLUMNS))
        for points, sums in zip(sources, support, strict=True):
            for surface in sources:  # right points agree with whichever is right there
                sum_cross_view(
                    points[rows].astype(np.float64), colors[rows], np.full(len(rows), -1), viewmats[near], Ks[near],
                    cameras.width, cameras.height, ids[near], surface, opaque, colors[:, None], 1.0, _SAME, 1.0, 0.0,
                    0, len(rows), sums,
                )  # fmt: skip
        ours, theirs = support[..., 1] - _COLOR * support[..., 4]
        chosen = np.full(pixels, (theirs > ours).sum() > _CLEAR * (theirs < ours).sum())
        clear = np.abs(theirs - ours) >= _ALONE
        chosen[rows[clear] - view * pixels] = theirs[clear] > ours[clear]
        return chosen

    return np.stack(parallel_map(in_view, range(views)))
