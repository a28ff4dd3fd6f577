"""Cut the Gaussians of a fit at the edges of the views, because no photo shows how far they reach beyond.

Gaussians across the edges of all views look like a soft rim and clouds around the scene to a viewer who steps back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gsmerge.fit.fit_state import FitState
from gsmerge.geometry.pooling import principal_axes
from gsmerge.geometry.transforms import camera_centres
from gsmerge.kernels.elementary import exp, log
from gsmerge.kernels.gaussians.edges import cut_at_edges
from gsmerge.kernels.gaussians.optimise import LOGIT, QUAT, SIZE
from gsmerge.kernels.matrices import matmul
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras

# Distance by which the edges are moved out. Its unit is the distance between neighbouring Gaussians, if the result were
# spread evenly over all photos. Border pixels also show Gaussians with centres outside of the picture
MARGIN = 2.0
ROWS = 16384  # Gaussians per task


@dataclass(frozen=True, eq=False)
class Edges:
    """Planes through the cameras of v views and the four edges of each, moved out."""

    normals: np.ndarray  # [v,4,3] outward, of unit length
    offsets: np.ndarray  # [v,4] points x inside have normal @ x <= offset


def find_edges(cameras: Cameras, count: int) -> Edges:
    """Return the edges of the pictures of cameras, moved out by ``MARGIN`` for a result of ``count`` Gaussians."""
    size, num = np.array([cameras.width, cameras.height]), len(cameras)
    margin = MARGIN * math.sqrt(num * cameras.width * cameras.height / max(1, count))
    Ks, viewmats = cameras.Ks.astype(np.float64), cameras.viewmats.astype(np.float64)
    focals, middles = Ks[:, [0, 1], [0, 1]], Ks[:, :2, 2]
    left, top = ((-margin - middles) / focals).T
    right, bottom = ((size + margin - middles) / focals).T
    zeros, ones = np.zeros(num), np.ones(num)
    sides = (-ones, zeros, left), (ones, zeros, -right), (zeros, -ones, top), (zeros, ones, -bottom)
    camera_normals = np.stack([np.stack(side, 1) for side in sides], 1)  # in the axes of each camera
    camera_normals /= np.sqrt((camera_normals**2).sum(2, keepdims=True))
    normals = np.stack([matmul(rows, viewmat[:3, :3]) for rows, viewmat in zip(camera_normals, viewmats, strict=True)])
    return Edges(normals, (normals * camera_centres(viewmats)[:, None]).sum(2))


def cut_state(state: FitState, edges: Edges) -> None:
    """Cut the Gaussians of a state at the edges of all views, in place, except fixed Gaussians.

    The limits of means move to the means after the cut. The limits of scales stay.
    """
    splats, x = state.splats, state.x
    means, covars, is_cut = splats.means.copy(), np.empty((len(x), 3, 3)), np.zeros(len(x), np.uint8)

    def cut(start: int) -> None:
        stop = min(start + ROWS, len(x))
        cut_at_edges(splats.quats, splats.scales, edges.normals, edges.offsets, start, stop, means, covars, is_cut)

    parallel_map(cut, range(0, len(x), ROWS))
    rows = np.flatnonzero(is_cut.astype(bool) & ~state.fixed)
    scales, quats = principal_axes(covars[rows])
    sizes = np.maximum(log(scales), state.min_sizes[rows, None])
    x[rows, :SIZE], x[rows, SIZE:QUAT], x[rows, QUAT:LOGIT] = means[rows], sizes, quats
    state.x0[rows, :SIZE] = means[rows]
    state.x0[rows, SIZE:QUAT] = np.sort(state.x0[rows, SIZE:QUAT], 1)  # as the scales of the new axes rise
    state.m[rows, :LOGIT] = 0  # momentum was along the old axes
    splats.means[rows], splats.scales[rows], splats.quats[rows] = means[rows], exp(x[rows, SIZE:QUAT]), quats
