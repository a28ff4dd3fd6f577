"""Choose between the depths of Gaussians and the depths of maps, by votes of other views.

Depth Anything 3 writes both.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.geometry import camera_centres, camera_depths, median, nearest_views, sh0_to_rgb
from gsmerge.kernels.gaussians.cross_view import COLUMNS, sum_cross_view
from gsmerge.kernels.pictures import blur
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Scene

# Tuned on exports of seven captures whose Gaussians or maps are off by 5 to 20 %, or along the ray
_SAME = 0.02  # largest difference of the logarithms of two depths of one surface
_MAX_FACTOR = 100.0  # by which the depth of a Gaussian may change
_NEIGHBORS, _STEP = 8, 4  # number of other views that vote, and the largest step between them in order of distance
_COLOR = 5.0  # reduction of a view's agreement per unit of difference in colour, sRGB in [0, 1]
_MIN_LEAD = 0.5  # in agreement, by which one depth of a pixel wins the vote
_MIN_DIFFERENT = 0.05  # share of a view's pixels whose depths differ; with fewer, no choice for the whole view
_CLEAR_LEAD = 0.2  # mean lead among the votes of a view and of the scene that decides for the whole view
# Otherwise the maps win a pixel if their lead among the votes around it exceeds the second number, and the share of
# pixels around it that vote exceeds the third. The first number is the standard deviation of the neighbourhood, pixels
_AROUND, _LOCAL_LEAD, _LOCAL_SHARE = 12.0, 0.6, 0.4


def choose_depths(scene: Scene, maps: np.ndarray, unit: float) -> tuple[Scene, int]:
    """Move the Gaussians of pixels to the depths ``maps [v,h,w]`` where other views confirm the maps.

    ``unit`` is the unit of the maps in the unit of the scene. If the other views do not confirm the maps in it, the
    unit is tried in which the median ratio of both depths is 1. Also returns the number of moved Gaussians. The scene
    itself is returned if no Gaussian moves.
    """
    views, g, fronts = len(scene), scene.gaussians, scene.get_pixels().fronts.reshape(len(scene), -1)
    viewmats, maps = scene.cameras.viewmats.astype(np.float64), maps.reshape(views, -1)
    usable, ratios = np.empty(fronts.shape, bool), np.empty(fronts.shape)

    def measure(view: int) -> None:
        depths, view_maps = camera_depths(g.means[fronts[view]], viewmats[view]), maps[view].astype(np.float64)
        usable[view] = (fronts[view] >= 0) & (depths > 0) & (view_maps > 0) & np.isfinite(view_maps)
        ratios[view] = np.where(usable[view], view_maps, 1) / np.where(usable[view], depths, 1)

    def change(view: int, scale: float) -> np.ndarray:
        """Return the factors ``[p]`` on the depths of the Gaussians that lead to the maps."""
        return np.where(usable[view], np.clip(scale * ratios[view], 1 / _MAX_FACTOR, _MAX_FACTOR), 1)

    parallel_map(measure, range(views))
    # mask [v,p] of pixels whose Gaussians move, means [v,p,3] at the depths of the maps, and factors [v,p] of the depth
    best: tuple[np.ndarray, ...] | None = None
    for choose_unit in (lambda: unit, lambda: 1 / median(ratios[usable])) if views > 1 and usable.any() else ():
        scale = choose_unit()
        if not any((np.abs(change(view, scale) - 1) > _SAME).any() for view in range(views)):
            return scene, 0
        factors, centres = np.stack([change(view, scale) for view in range(views)]), camera_centres(viewmats)
        differ, means = np.abs(factors - 1) > _SAME, g.means[fronts]
        map_means = np.stack([
            centre + (view_means - centre) * view_factors[:, None]
            for centre, view_means, view_factors in zip(centres, means, factors, strict=True)
        ])  # fmt: skip
        votes = _count_votes(scene, means, map_means, differ)
        lead = float(votes.sum() / max(1, np.abs(votes).sum()))
        if scale == unit or lead > _CLEAR_LEAD:
            best = _select_pixels(votes, differ) & usable, map_means, factors
        if lead > _CLEAR_LEAD:
            break
    if best is None:
        return scene, 0
    is_moved, map_means, factors = best
    rows = fronts[is_moved]
    if len(rows) == 0:
        return scene, 0
    means, scales = g.means.copy(), g.scales.copy()
    means[rows], scales[rows] = map_means[is_moved], g.scales[rows] * factors[is_moved][:, None]
    return replace(scene, gaussians=replace(g, means=means, scales=scales)), len(rows)


def _count_votes(scene: Scene, means: np.ndarray, map_means: np.ndarray, differ: np.ndarray) -> np.ndarray:
    """Let other views vote ``[v,h,w]`` on each pixel: 1 for the depth map, -1 for the Gaussian, 0 for neither.

    ``means [v,p,3]`` are the Gaussians, and ``map_means [v,p,3]`` the same Gaussians at the depths of the maps. A view
    votes for the point that lies on its own surface and has its colour there. It votes on the pixels of other views
    that are True in ``differ [v,p]``.
    """
    cameras, (views, pixels) = scene.cameras, differ.shape
    viewmats, Ks = (np.ascontiguousarray(array, np.float64) for array in (cameras.viewmats, cameras.Ks))
    scene_pixels = scene.get_pixels()
    shown = scene_pixels.shown
    images = sh0_to_rgb(scene.gaussians.sh0[scene_pixels.fronts]) if scene.images is None else scene.images
    colors, opaque = np.ascontiguousarray(images, np.float32).reshape(-1, 3), np.ones(differ.size, np.float32)
    both_points = [np.ascontiguousarray(points, np.float32).reshape(-1, 3) for points in (means, map_means)]
    ids = np.where(shown, np.arange(differ.size, dtype=np.int32).reshape(shown.shape), -1)
    centres = camera_centres(viewmats)

    def vote(view: int) -> np.ndarray:
        rows = view * pixels + np.flatnonzero(differ[view])
        voters = nearest_views(centres, view)[:: min(max(1, views // _NEIGHBORS), _STEP)][:_NEIGHBORS]
        # points of no view, so that all voters compare all points
        no_view, no_pairs = np.full(len(rows), -1), np.empty((len(voters), 0), np.int32)
        sums = np.zeros((2, len(rows), COLUMNS))
        for points, out in zip(both_points, sums, strict=True):
            for surface in both_points:  # right points agree with whichever surface of the voter is right
                sum_cross_view(
                    points[rows].astype(np.float64), colors[rows], no_view, no_pairs, viewmats[voters], Ks[voters],
                    cameras.width, cameras.height, ids[voters], surface, opaque, colors[:, None], 1.0, _SAME, 1.0, 0.0,
                    0, len(rows), out,
                )  # fmt: skip
        for_gaussians, for_maps = np.maximum(sums[..., 1] - _COLOR * sums[..., 4], 0)
        votes = np.zeros(pixels, np.int64)
        votes[rows - view * pixels] = np.sign(np.trunc((for_maps - for_gaussians) / _MIN_LEAD))
        return votes

    return np.stack(parallel_map(vote, range(views))).reshape(shown.shape)


def _select_pixels(votes: np.ndarray, differ: np.ndarray) -> np.ndarray:
    """Select the pixels ``[v,p]`` that take the depth of the map.

    A clear lead in the votes of a view and of the scene decides for the whole view. Otherwise the votes around each
    pixel decide.
    """
    sums, counts = votes.sum((1, 2)), np.abs(votes).sum((1, 2))
    leads = (sums / np.maximum(counts, 1) + sums.sum() / max(counts.sum(), 1)) / 2
    leads[differ.mean(1) < _MIN_DIFFERENT] = 0
    blurred = np.stack([blur(np.stack([view_votes, np.abs(view_votes)], -1), _AROUND) for view_votes in votes])
    local_sums, local_counts = blurred[..., 0], blurred[..., 1]
    wins_locally = (local_sums > _LOCAL_LEAD * local_counts) & (local_counts > _LOCAL_SHARE)
    leads, is_clear = leads[:, None, None], np.abs(leads[:, None, None]) > _CLEAR_LEAD
    return np.where(is_clear, leads > 0, wins_locally).reshape(differ.shape)
