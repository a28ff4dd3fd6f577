"""Guess depths of pixels that an exporter dropped: of borders, and of the farthest ones."""

from __future__ import annotations

import numpy as np

from gsmerge.alignment.layouts import da3_box
from gsmerge.geometry import camera_depths, project_points
from gsmerge.kernels.matrices import invert, matmul
from gsmerge.types import Scene

_FACTORS = np.geomspace(1, 8, 13)  # of the largest depth that was kept: those of far pixels
_FARTHER = 0.003  # distance of colours, 0 to 1, that the next factor must gain
_LARGEST = 0.99  # quantile that counts as the largest
_OTHERS = 4  # nearest views that a photo is compared with
_AROUND = 6  # pixels on either side over which colours are compared


def guess_depths(scene: Scene) -> np.ndarray:
    """Guess depth maps ``[v,h,w]`` along z of a scene without borders and the farthest pixels.

    Where rows are, the maps have their depths. Far pixels get the depth at which the nearest other
    photos have their colours, and a border that of the pixel beside it.
    """
    views, height, width = scene.valid.shape
    box = da3_box(width, height)
    y = np.arange(height).clip(box.top, height - 1 - box.top)
    x = np.arange(width).clip(box.left, width - 1 - box.left)
    means = scene.gaussians.means.astype(np.float64).reshape(views, -1, 3)
    maps = np.empty((views, height, width))
    for view in range(views):
        kept = scene.valid[view]
        viewmat = scene.cameras.viewmats[view]
        points = means[view]
        depth = camera_depths(points, np.broadcast_to(viewmat, (len(points), 4, 4)))
        depth = depth.reshape(height, width)
        far = ~kept
        far[: box.top] = far[height - box.top :] = False
        far[:, : box.left] = far[:, width - box.left :] = False
        if kept.any():
            largest = float(np.quantile(depth[kept], _LARGEST))
            depth[far] = largest * _far_factors(scene, view, far, largest)
        maps[view] = np.where(kept, depth, depth[np.ix_(y, x)])
    return maps


def _far_factors(scene: Scene, view: int, far: np.ndarray, depth: float) -> np.ndarray:
    """Choose factors ``[p]`` on a depth under which photos agree, for pixels ``far [h,w]``."""
    images = scene.images
    cameras = scene.cameras
    if images is None or not far.any():
        return np.ones(int(far.sum()))
    y, x = np.nonzero(far)
    pixels = np.stack([x + 0.5, y + 0.5, np.ones(len(x))], 1)
    viewmat = cameras.viewmats[view]
    rays = matmul(matmul(pixels, invert(cameras.Ks[view]).T), viewmat[:3, :3])
    centres = cameras.centres
    away = np.linalg.norm(centres - centres[view], axis=1)
    others = np.argsort(away, kind="stable")[1 : 1 + _OTHERS]
    own = images[view, y, x]
    costs = np.empty((len(_FACTORS), len(x)))
    for i, factor in enumerate(_FACTORS):
        points = centres[view] + factor * depth * rays
        total, count = np.zeros(len(x)), np.zeros(len(x))
        for other in others:
            with np.errstate(all="ignore"):
                xy, z = project_points(points, cameras.viewmats[other], cameras.Ks[other])
            inside = (z > 0) & (xy >= 0).all(1) & (xy < (cameras.width, cameras.height)).all(1)
            column, row = xy[inside].astype(np.int64).T
            total[inside] += np.abs(own[inside] - images[other, row, column]).mean(1)
            count[inside] += 1
        seen = np.zeros((2, *far.shape))
        seen[0, y, x] = total
        seen[1, y, x] = count
        total, count = _sums_around(seen)[:, y, x]
        costs[i] = np.where(count > 0, total / np.maximum(count, 1), np.inf)
    known = np.isfinite(costs).all(0)
    chosen = (costs + _FARTHER * np.arange(len(_FACTORS))[:, None]).argmin(0)
    if known.any():
        chosen[~known] = int(np.median(chosen[known]))
    return _FACTORS[chosen]


def _sums_around(pictures: np.ndarray) -> np.ndarray:
    """Sum pictures ``[n,h,w]`` over squares around each pixel, zero outside."""
    side = 2 * _AROUND + 1
    padded = np.pad(pictures, ((0, 0), (_AROUND + 1, _AROUND), (_AROUND + 1, _AROUND)))
    total = padded.cumsum(1)
    rows = total[:, side:] - total[:, :-side]
    total = rows.cumsum(2)
    return np.asarray(total[:, :, side:] - total[:, :, :-side])
