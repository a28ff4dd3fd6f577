"""Scene with pixels -> the share of its depth that other views confirm, which predicts whether a fit can succeed.

Each pixel's Gaussian is projected into the other views. The Gaussian in front there is projected back into the first
view. If it lands near the pixel, at about the same depth, the other view confirms the pixel. A pixel is contradicted if
more views see through its surface than confirm it, and alone if its position is outside of all other views. A pixel
does not count if other views have no Gaussian at its position, for example beyond a crop.
"""

from __future__ import annotations

import numpy as np

from gsmerge.method.facts.agreement import CONFIRM_PIXELS, Agreement
from gsmerge.method.geometry.frame import scene_depth
from gsmerge.method.geometry.transforms import camera_depths, nearest_views, project
from gsmerge.method.kernels.elementary import log
from gsmerge.prepare.surfaces import SAME_LOG_DEPTH
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Scene

CONFIRM_NEIGHBORS = 16  # nearest other views in which the sampled pixels are looked up
# A point that is projected back agrees with its pixel up to a distance: the share AGREEMENT_SHARE of the longer side,
# but at least AGREEMENT_PIXELS
AGREEMENT_SHARE = 1 / 120
AGREEMENT_PIXELS = 1.5
LEAST_DEPTH = 1e-9  # least depth, canonical units
# Parts of pictures, as ranges of columns and of rows in thirds. A part is poor if the share of its pixels that other
# views contradict, or the share that no other view sees, is above POOR_PART_SHARE
THIRDS = {
    "left third": ((0, 1), (0, 3)), "right third": ((2, 3), (0, 3)), "upper third": ((0, 3), (0, 1)),
    "lower third": ((0, 3), (2, 3)), "middle": ((1, 2), (1, 2)),
}  # fmt: skip
POOR_PART_SHARE = 0.5  # share of a part's pixels


def confirm_depths(scene: Scene) -> Agreement | None:
    """Measure the shares of depth that the views of a scene confirm, contradict, or do not see.

    Returns None with fewer than two views, or if no pixel counts. Returns None also if views share Gaussians, because a
    shared Gaussian would confirm itself.
    """
    pixels = scene.pixels
    if len(scene) < 2 or pixels is None or not pixels.own or not pixels.shown.any():
        return None
    counts = np.stack(parallel_map(lambda view: _count_view(scene, view), range(len(scene))))
    num_pixels = int(counts[:, 0, 0].sum())
    if num_pixels == 0:
        return None
    cameras = scene.cameras
    baseline = np.linalg.norm(np.ptp(cameras.centres, axis=0))
    from_one_point = baseline * cameras.Ks[:, 0, 0].max() < AGREEMENT_PIXELS * scene_depth(scene)
    confirmed, contradicted, alone = counts[:, 0, 1:].sum(0) / num_pixels
    contradicted_part, alone_part = (_worst_part(counts[:, 1:, kind], counts[:, 1:, 0]) for kind in (2, 3))
    return Agreement(
        float(confirmed), contradicted=float(contradicted), alone=float(alone), num_pixels=num_pixels,
        contradicted_part=contradicted_part, alone_part=alone_part, from_one_point=bool(from_one_point),
    )  # fmt: skip


def _count_view(scene: Scene, view: int) -> np.ndarray:
    """Count the sampled pixels of a view, ``[part,4]``: those that count, are confirmed, are contradicted, are alone.

    The first part is the whole picture; the other parts are ``THIRDS``. The pixels are looked up in the nearest other
    views.
    """
    means = scene.gaussians.means
    cameras = scene.cameras
    width = cameras.width
    height = cameras.height
    fronts = scene.get_pixels().fronts.reshape(len(scene), -1)
    rows = np.flatnonzero(fronts[view] >= 0)
    rows = rows[np.random.default_rng(view).integers(max(len(rows), 1), size=min(len(rows), CONFIRM_PIXELS))]
    points = means[fronts[view, rows]].astype(np.float64)
    neighbors = nearest_views(cameras.centres, view)[:CONFIRM_NEIGHBORS]
    pixels, depths = project(points, cameras[neighbors])
    x = pixels[..., 0]
    y = pixels[..., 1]
    inside = (depths > LEAST_DEPTH) & (x > 0) & (y > 0) & (x < width) & (y < height)
    neighbor_ids, ids = np.nonzero(inside)  # pairs of a neighbour and a point in its picture
    column = x[neighbor_ids, ids].astype(np.int64)
    row = y[neighbor_ids, ids].astype(np.int64)
    front = fronts[neighbors[neighbor_ids], row * width + column]
    has_front = front >= 0
    # only pairs with a Gaussian at the point's pixel
    neighbor_ids = neighbor_ids[has_front]
    ids = ids[has_front]
    is_alone = np.asarray(~inside.any(0))  # no view sees the pixel's position
    is_counted = is_alone.copy()
    is_counted[ids] = True
    # Project the points that the neighbours show at these pixels back into the view. The distance from the pixel is in
    # units of the distance up to which a point agrees with its pixel. Points behind the camera are infinitely far
    surface = means.take(front[has_front], 0).astype(np.float64)
    own_pixels = np.stack([rows[ids] % width, rows[ids] // width], 1) + 0.5
    (projected,), (own_depths,) = project(surface, cameras[[view]])
    right, down = (projected - own_pixels).T
    reach = max(AGREEMENT_PIXELS, AGREEMENT_SHARE * max(width, height))
    distance = np.where(own_depths > LEAST_DEPTH, np.sqrt(right * right + down * down), np.inf) / reach
    surface_depths = camera_depths(surface, cameras.viewmats[neighbors[neighbor_ids]])
    # distance of the point behind the neighbour's surface; negative in front of the surface
    log_depths = log(depths[neighbor_ids, ids] / np.maximum(surface_depths, LEAST_DEPTH))
    agrees = (distance < 1) & (np.abs(log_depths) < SAME_LOG_DEPTH)
    sees_through = ~agrees & ((log_depths < -2 * SAME_LOG_DEPTH) | ((log_depths < 0) & (distance > 2)))
    num_same, num_through = (np.bincount(ids[mask], minlength=len(rows)) for mask in (agrees, sees_through))
    kinds = (num_same > 0) & (num_same >= num_through), num_through > num_same, is_alone
    # in thirds of the picture
    column = 3 * (rows % width) // width
    row = 3 * (rows // width) // height
    parts = [is_counted]
    for (left, right_end), (top, bottom) in THIRDS.values():
        parts.append(is_counted & (column >= left) & (column < right_end) & (row >= top) & (row < bottom))
    return np.array([[part.sum(), *((part & kind).sum() for kind in kinds)] for part in parts])


def _worst_part(poor: np.ndarray, pixels: np.ndarray) -> str:
    """Name the part of the pictures that is poor in most views, as "left third of 4 of 7 views".

    ``poor [v,part]`` are numbers of poor pixels, and ``pixels [v,part]`` of all pixels that count. The result is empty
    if all parts are poor in the same number of views, because then no part stands out.
    """
    views = (poor > POOR_PART_SHARE * np.maximum(pixels, 1)).sum(0)
    worst = int(views.argmax())
    if views[worst] == 0 or views.min() == views[worst]:
        return ""
    return f"{list(THIRDS)[worst]} of {views[worst]} of {len(poor)} views"
