"""Choose between depths of Gaussians and of depth maps beside them, as Depth Anything 3 writes both, by other views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.geometry import camera_centres, camera_depths, nearest_views, sh0_to_rgb
from gsmerge.kernels.gaussians.cross_view import COLUMNS, sum_cross_view
from gsmerge.kernels.pictures import blur
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Scene

# Chosen on exports of seven captures whose Gaussians or maps are off by 5 to 20 %, or along the ray
_SAME = 0.02  # logarithm of two depths of one surface
_MOST = 100.0  # times its depth by which a Gaussian is moved
_NEIGHBORS, _STEP = 8, 4  # other views that are asked: of many views every so many of the nearest
_COLOR = 5.0  # what a view's agreement loses for a unit of difference in colour, sRGB in [0, 1]
_WON = 0.5  # of a view's agreement, by which one depth of a pixel must be ahead
_DIFFERENT = 0.05  # least share of a view's pixels whose depths differ, for a choice for all of them
_CLEAR = 0.2  # lead, of the votes of a view and of the scene, that decides for all its pixels
_AROUND, _HERE, _ASKED = 12.0, 0.6, 0.4  # else the maps need this lead so many pixels around, this share of which vote


def choose_depths(scene: Scene, maps: np.ndarray, unit: float) -> tuple[Scene, int]:
    """Place Gaussians in front of pixels at the depths ``maps [v,h,w]`` where other views confirm these, not them.

    ``unit``: that of the maps in the scene's; if the maps are not confirmed in it, their median ratio to the Gaussians'
    depths is tried. Also returns how many were placed; the scene itself is returned where the Gaussians are as good.
    """
    views, g, fronts = len(scene), scene.gaussians, scene.get_pixels().fronts.reshape(len(scene), -1)
    viewmats, maps = scene.cameras.viewmats.astype(np.float64), maps.reshape(views, -1).astype(np.float64)
    centres, means = camera_centres(viewmats), g.means[fronts]
    depths = camera_depths(means, viewmats[:, None])
    usable = (fronts >= 0) & (depths > 0) & (maps > 0) & np.isfinite(maps)
    ratios = np.where(usable, maps, 1) / np.where(usable, depths, 1)
    best = np.zeros_like(usable), means, ratios
    for scale in (unit, 1 / float(np.median(ratios[usable]))) if views > 1 and usable.any() else ():
        factors = np.where(usable, np.clip(scale * ratios, 1 / _MOST, _MOST), 1)
        differ = np.abs(factors - 1) > _SAME
        if not differ.any():
            return scene, 0
        placed = np.stack([c + (m - c) * f[:, None] for c, m, f in zip(centres, means, factors, strict=True)])
        votes = _count_votes(scene, means, placed, differ)
        lead = float(votes.sum() / max(1, np.abs(votes).sum()))
        if scale == unit or lead > _CLEAR:
            best = _follow_votes(votes, differ) & usable, placed, factors
        if lead > _CLEAR:
            break
    chosen, placed, factors = best
    rows = fronts[chosen]
    if len(rows) == 0:
        return scene, 0
    means, scales = g.means.copy(), g.scales.copy()
    means[rows], scales[rows] = placed[chosen], g.scales[rows] * factors[chosen][:, None]
    return replace(scene, gaussians=replace(g, means=means, scales=scales)), len(rows)


def _count_votes(scene: Scene, means: np.ndarray, placed: np.ndarray, differ: np.ndarray) -> np.ndarray:
    """Ask other views which points show their surfaces: 1 for ``placed [v,p,3]``, -1 for the Gaussians at ``means``.

    ``differ [v,p]``: pixels that are asked for; the votes ``[v,h,w]`` of others, and in doubt, are 0.
    """
    cameras, (views, pixels) = scene.cameras, differ.shape
    viewmats, Ks = (np.ascontiguousarray(array, np.float64) for array in (cameras.viewmats, cameras.Ks))
    shown_by = scene.get_pixels()
    there = shown_by.shown
    shown = sh0_to_rgb(scene.gaussians.sh0[shown_by.fronts]) if scene.images is None else scene.images
    colors, opaque = np.ascontiguousarray(shown, np.float32).reshape(-1, 3), np.ones(differ.size, np.float32)
    sources = [np.ascontiguousarray(points, np.float32).reshape(-1, 3) for points in (means, placed)]
    ids = np.where(there, np.arange(differ.size, dtype=np.int32).reshape(there.shape), -1)
    centres = camera_centres(viewmats)

    def ask(view: int) -> np.ndarray:
        rows = view * pixels + np.flatnonzero(differ[view])
        near = nearest_views(centres, view)[:: min(max(1, views // _NEIGHBORS), _STEP)][:_NEIGHBORS]
        own, asked = np.full(len(rows), -1), np.empty((len(near), 0), np.int32)  # points of no view: all are asked
        sums = np.zeros((2, len(rows), COLUMNS))
        for points, out in zip(sources, sums, strict=True):
            for surface in sources:  # right points agree with whichever is right there
                sum_cross_view(
                    points[rows].astype(np.float64), colors[rows], own, asked, viewmats[near], Ks[near],
                    cameras.width, cameras.height, ids[near], surface, opaque, colors[:, None], 1.0, _SAME, 1.0, 0.0,
                    0, len(rows), out,
                )  # fmt: skip
        ours, theirs = np.maximum(sums[..., 1] - _COLOR * sums[..., 4], 0)
        votes = np.zeros(pixels, np.int64)
        votes[rows - view * pixels] = np.sign(np.trunc((theirs - ours) / _WON))
        return votes

    return np.stack(parallel_map(ask, range(views))).reshape(there.shape)


def _follow_votes(votes: np.ndarray, differ: np.ndarray) -> np.ndarray:
    """Return for which pixels ``[v,p]`` the maps are ahead: in their view and the scene, or in the pixels around."""
    of_views, cast = votes.sum((1, 2)), np.abs(votes).sum((1, 2))
    leads = (of_views / np.maximum(cast, 1) + of_views.sum() / max(cast.sum(), 1)) / 2
    leads[differ.mean(1) < _DIFFERENT] = 0
    around = np.stack([blur(np.stack([of_view, np.abs(of_view)], -1), _AROUND) for of_view in votes])
    here = (around[..., 0] > _HERE * around[..., 1]) & (around[..., 1] > _ASKED)
    leads, decided = leads[:, None, None], np.abs(leads[:, None, None]) > _CLEAR
    return np.where(decided, leads > 0, here).reshape(differ.shape)
