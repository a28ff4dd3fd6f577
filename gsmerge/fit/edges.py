"""Cut the Gaussians of a fit at the edges of the views, because no photo shows how far they reach beyond.

Gaussians across the edges of all views look like a soft rim and clouds around the scene to a viewer who steps back. A
cut leaves a Gaussian as soft as it is large, so large ones are split along the edge after the fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gsmerge.fit.fit_state import FitState, state_of
from gsmerge.fit.growth import OFFSET, fade_halves
from gsmerge.geometry.pooling import principal_axes
from gsmerge.geometry.transforms import camera_centres, camera_depths, covariances
from gsmerge.kernels.elementary import exp, log
from gsmerge.kernels.gaussians.edges import cut_at_edges
from gsmerge.kernels.gaussians.optimise import LOGIT, QUAT, SIZE
from gsmerge.kernels.matrices import matmul
from gsmerge.raster import Splats
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras

# Distance by which the edges are moved out. Its unit is the distance between neighbouring Gaussians, if the result were
# spread evenly over all photos. Border pixels also show Gaussians with centres outside of the picture
MARGIN = 2.0
ROWS = 16384  # Gaussians per task
REACH = 2.0  # standard deviations to which a Gaussian reaches, as in the kernel
SOFT = 0.01  # widest soft part of a split Gaussian, as a share of the width of the view
FALL = 1.69  # its unit: standard deviations in which the opacity of an opaque Gaussian falls from .9 to .1
# Opacity at the edge above which a Gaussian is split. Fainter ones are haze before the scene: splitting them changes
# the photos by up to 1 dB, and narrows the rim little
SHOWN = 0.2


@dataclass(frozen=True, eq=False)
class Edges:
    """Planes through the cameras of v views and the four edges of each, moved out."""

    normals: np.ndarray  # [v,4,3] outward, of unit length
    offsets: np.ndarray  # [v,4] points x inside have normal @ x <= offset
    cameras: Cameras


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
    return Edges(normals, (normals * camera_centres(viewmats)[:, None]).sum(2), cameras)


def cut_state(state: FitState, edges: Edges) -> None:
    """Cut the Gaussians of a state at the edges of all views, in place, except fixed Gaussians.

    The limits of means move to the means after the cut. The limits of scales stay.
    """
    splats, x = state.splats, state.x
    means, covars, is_cut = _cut(splats, edges)
    rows = np.flatnonzero(is_cut & ~state.fixed)
    scales, quats = principal_axes(covars[rows])
    sizes = np.maximum(log(scales), state.min_sizes[rows, None])
    x[rows, :SIZE], x[rows, SIZE:QUAT], x[rows, QUAT:LOGIT] = means[rows], sizes, quats
    state.x0[rows, :SIZE] = means[rows]
    state.x0[rows, SIZE:QUAT] = np.sort(state.x0[rows, SIZE:QUAT], 1)  # as the scales of the new axes rise
    state.m[rows, :LOGIT] = 0  # momentum was along the old axes
    splats.means[rows], splats.scales[rows], splats.quats[rows] = means[rows], exp(x[rows, SIZE:QUAT]), quats


def _cut(splats: Splats, edges: Edges) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut Gaussians; return means ``[n,3]``, covariances ``[n,3,3]`` of those that are cut, and their mask ``[n]``."""
    count = len(splats.means)
    means, covars, is_cut = splats.means.copy(), np.empty((count, 3, 3)), np.zeros(count, np.uint8)

    def cut(start: int) -> None:
        stop = min(start + ROWS, count)
        cut_at_edges(splats.quats, splats.scales, edges.normals, edges.offsets, start, stop, means, covars, is_cut)

    parallel_map(cut, range(0, count, ROWS))
    return means, covars, is_cut.astype(bool)


def split_at_edges(state: FitState, edges: Edges, count: int) -> FitState:
    """Split Gaussians along the edges and drop what lies beyond, until the rim is narrow or there are ``count``.

    The returned state is for the end of a fit; it has no moments. The softest Gaussians are split first. If none is
    split, the given state is returned.
    """
    x, fresh = state.x, np.flatnonzero(_cut(state.splats, edges)[2])
    rows, is_split = np.arange(len(x)), np.zeros(len(x), bool)
    while len(x) < count:
        covars = covariances(x[fresh, QUAT:LOGIT].astype(np.float64), exp(x[fresh, SIZE:QUAT].astype(np.float64)))
        normals, rooms, widths = _find_nearest(x[fresh, :SIZE].astype(np.float64), covars, edges)
        opacities = exp(-np.square(np.maximum(rooms, 0)) / 2) / (1 + exp(-x[fresh, LOGIT].astype(np.float64)))
        soft = np.flatnonzero((np.abs(rooms) < REACH) & (widths > SOFT) & ((opacities > SHOWN) | is_split[fresh]))
        soft = soft[np.argsort(-widths[soft], kind="stable")[: count - len(x)]]
        if len(soft) == 0:
            break
        inner, outer = _split_across(x[fresh[soft]], covars[soft], normals[soft])
        shown = rooms[soft] > 0  # at most a sixth of the other outer halves lies inside
        x = np.concatenate([x, outer[shown]])
        x[fresh[soft]], is_split[fresh[soft]] = inner, True
        rows = np.concatenate([rows, rows[fresh[soft[shown]]]])
        fresh = np.concatenate([fresh[soft], np.arange(len(is_split), len(x))])
        is_split = np.concatenate([is_split, np.ones(len(x) - len(is_split), bool)])
    if not is_split.any():
        return state
    split = state_of(x, state.splats.shN[rows])
    split.origins, split.min_sizes, split.fixed = state.origins[rows], state.min_sizes[rows], ~is_split
    cut_state(split, edges)
    return split


def _split_across(parents: np.ndarray, covars: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split parameters ``[m,14]`` of Gaussians across planes; return those of the halves inside and outside."""
    steps = matmul(covars, normals[..., None])[..., 0]
    steps *= OFFSET / np.sqrt((steps * normals).sum(1, keepdims=True))
    scales, quats = principal_axes(covars - steps[:, :, None] * steps[:, None, :])
    inner = parents.copy()
    inner[:, SIZE:QUAT], inner[:, QUAT:LOGIT], inner[:, LOGIT] = log(scales), quats, fade_halves(parents[:, LOGIT])
    outer = inner.copy()
    inner[:, :SIZE] -= steps
    outer[:, :SIZE] += steps
    return inner, outer


def _find_nearest(means: np.ndarray, covars: np.ndarray, edges: Edges) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the nearest edge of the view in which each of n Gaussians lies deepest.

    Returns the normal ``[n,3]`` of its plane, the distance ``[n]`` inside the plane in standard deviations across it,
    and the width ``[n]`` of the soft part of the Gaussian as a share of the view's width.
    """
    rows, rooms, cameras = np.arange(len(means)), np.full(len(means), -np.inf), edges.cameras
    nearest, widths = np.zeros((len(means), 3)), np.zeros(len(means))
    for view, (normals, offsets) in enumerate(zip(edges.normals, edges.offsets, strict=True)):
        sigmas = np.sqrt((matmul(normals, covars) * normals).sum(2))  # [n,4]
        distances = (offsets - matmul(means, normals.T)) / sigmas
        edge = distances.argmin(1)
        deeper = distances[rows, edge] > rooms
        rooms[deeper], nearest[deeper] = distances[rows, edge][deeper], normals[edge][deeper]
        depths = np.maximum(camera_depths(means, cameras.viewmats[view].astype(np.float64)), 1e-9)
        soft = FALL * float(cameras.Ks[view, 0, 0]) / cameras.width * sigmas[rows, edge] / depths
        widths[deeper] = soft[deeper]
    return nearest, rooms, widths
