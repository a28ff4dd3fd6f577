"""What the other views' Gaussians say of a Feature Gaussian: no photo is looked at."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsmerge.moments import Members
from gsmerge.threads import parallel_map
from gsmerge.types import SH_C0, Cameras

EVIDENCE = 7
NEAR = 0.03  # relative difference of depths that still is the same surface
FAR = 0.3  # differences are held within
LEAST = 1 / 255  # opacity of a Gaussian that says anything


def evidence(means: Tensor, sh0: Tensor, views: Tensor, members: Members, cameras: Cameras) -> Tensor:
    """Agreement with the Gaussian of the pixel that each point falls on in every other view.

    Args:
        means: ``[g,3]``.
        sh0: ``[g,1,3]`` base colours.
        views: ``[g]`` view that each was seen in, which is not asked.
        members: The scene's Gaussians, one per pixel; in no order, nothing is known.
        cameras: All views.

    Returns:
        ``[g,7]``: logarithm of the number of views that see it; the shares of these that have a surface there, behind
        it, and before it; the difference of colours and the mean relative difference of depths; the logarithm of the
        number of views.
    """
    found = torch.zeros(len(means), EVIDENCE)
    found[:, 6] = float(np.log(len(cameras))) / 4
    if members.pixels is not None or len(means) == 0:
        return found
    points, colors, own = means.double().numpy(), SH_C0 * sh0[:, 0].numpy(), views.numpy()

    def one_view(view: int) -> tuple[np.ndarray, np.ndarray]:
        rows, depths, ids = _pixels(points, own, view, cameras)
        third = cameras.viewmats[view, 2].double().numpy()
        there = members.means[ids] @ third[:3] + third[3]
        usable = (there > 0) & (members.opacities[ids] > LEAST)
        rows, ids, ratio = rows[usable], ids[usable], np.log(depths[usable] / there[usable])
        same = np.abs(ratio) < NEAR
        color = same * np.abs(colors[rows] - SH_C0 * members.sh[ids, 0]).mean(1)
        columns = (np.ones(len(rows)), same, ratio <= -NEAR, ratio >= NEAR, color, np.clip(ratio, -FAR, FAR))
        return rows, np.stack(columns, 1)

    sums = np.zeros((len(points), EVIDENCE - 1))
    for rows, columns in parallel_map(one_view, range(len(cameras))):  # in the order of the views
        sums[rows] += columns
    num_seen, num_same = np.maximum(sums[:, 0], 1), np.maximum(sums[:, 1], 1)
    shares = [sums[:, 1] / num_seen, sums[:, 2] / num_seen, sums[:, 3] / num_seen, sums[:, 4] / num_same]
    columns = np.stack([np.log1p(sums[:, 0]) / 3, *shares, sums[:, 5] / num_seen / FAR], 1)
    found[:, :6] = torch.from_numpy(columns).float()
    return found


def _pixels(
    points: np.ndarray, own: np.ndarray, view: int, cameras: Cameras
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points that a view sees although it is not their own: rows, depths, and the Gaussians of their pixels."""
    viewmat, K = cameras.viewmats[view].double().numpy(), cameras.Ks[view].double().numpy()
    camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    rows = np.flatnonzero((camera[:, 2] > 1e-9) & (own != view))
    image = camera[rows] @ K.T
    places = np.floor(image[:, :2] / image[:, 2:])
    inside = ((places >= 0) & (places < (cameras.width, cameras.height))).all(1)
    rows, places = rows[inside], places[inside].astype(np.int64)
    ids = (view * cameras.height + places[:, 1]) * cameras.width + places[:, 0]
    return rows, camera[rows, 2], ids
