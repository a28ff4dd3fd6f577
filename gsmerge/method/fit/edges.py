"""Cut the Gaussians of a fit at the edges of the views, because no photo shows how far they reach beyond its edges.

A view has four edges, the borders of its picture. In space, an edge is the plane through the camera and a border. A
viewer who steps back sees Gaussians that reach across the edges as a soft rim and as clouds around the scene. A cut
makes a Gaussian smaller. The border of a large Gaussian is still wide and soft after the cut, so large Gaussians are
also split along the edge after the fit.
"""

from __future__ import annotations

import math

import numpy as np

from gsmerge.frozen import dataclass
from gsmerge.method.fit.fit_state import FitState, state_of
from gsmerge.method.fit.growth import OFFSET, fade_halves
from gsmerge.method.geometry.pooling import principal_axes
from gsmerge.method.geometry.transforms import camera_centres, camera_depths, covariances
from gsmerge.method.kernels.elementary import exp, log
from gsmerge.method.kernels.gaussians.optimise import LOGIT, QUAT, SIZE, cut_at_edges
from gsmerge.method.kernels.matrices import matmul
from gsmerge.method.raster import Splats
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras

# The edges are moved out, because pixels at a border also show Gaussians with centres outside of the picture. MARGIN is
# in units of the distance that neighbouring Gaussians would have if the result were spread evenly over all photos
MARGIN = 2.0
ROWS = 16384  # Gaussians per task
REACH = 2.0  # a Gaussian ends at this many standard deviations, as in kernels/gaussians/edges.c
SOFT = 0.01  # a Gaussian is split if its soft border is wider than the share SOFT of the view
FALL = 1.69  # standard deviations over which the opacity of an opaque Gaussian falls from .9 to .1: its soft border
# A Gaussian is split only if its opacity at the edge is above SHOWN. Fainter Gaussians are haze in front of the scene.
# Splits of haze would change the photos by up to 1 dB, and hardly narrow the soft rim of the scene
SHOWN = 0.2


@dataclass(frozen=True, eq=False)
class Edges:
    """Planes through the cameras of v views and the four borders of each picture, moved out by ``MARGIN``."""

    normals: np.ndarray  # [v,4,3] outward, of unit length
    offsets: np.ndarray  # [v,4] points x inside have normal @ x <= offset
    cameras: Cameras


def find_edges(cameras: Cameras, count: int) -> Edges:
    """Return the edges of the views of ``cameras``, moved out by ``MARGIN`` for a result of ``count`` Gaussians."""
    size = np.array([cameras.width, cameras.height])
    num = len(cameras)
    margin = MARGIN * math.sqrt(num * cameras.width * cameras.height / max(1, count))
    Ks = cameras.Ks.astype(np.float64)
    viewmats = cameras.viewmats.astype(np.float64)
    focals = Ks[:, [0, 1], [0, 1]]
    middles = Ks[:, :2, 2]
    left, top = ((-margin - middles) / focals).T
    right, bottom = ((size + margin - middles) / focals).T
    zeros = np.zeros(num)
    ones = np.ones(num)
    sides = (-ones, zeros, left), (ones, zeros, -right), (zeros, -ones, top), (zeros, ones, -bottom)
    camera_normals = np.stack([np.stack(side, 1) for side in sides], 1)  # in the axes of each camera
    camera_normals /= np.sqrt((camera_normals**2).sum(2, keepdims=True))
    normals = np.stack([matmul(rows, viewmat[:3, :3]) for rows, viewmat in zip(camera_normals, viewmats, strict=True)])
    return Edges(normals, (normals * camera_centres(viewmats)[:, None]).sum(2), cameras)


def cut_state(state: FitState, edges: Edges) -> None:
    """Cut the Gaussians of a state at the edges of all views, in place, except fixed Gaussians.

    After a cut, the box in which a mean may move is centred at the new mean. The limits of the scales do not change.
    """
    splats = state.splats
    x = state.x
    means, covars, is_cut = _compute_cuts(splats, edges)
    rows = np.flatnonzero(is_cut & ~state.fixed)
    scales, quats = principal_axes(covars[rows])
    sizes = np.maximum(log(scales), state.min_sizes[rows, None])
    x[rows, :SIZE] = means[rows]
    x[rows, SIZE:QUAT] = sizes
    x[rows, QUAT:LOGIT] = quats
    state.x0[rows, :SIZE] = means[rows]
    state.x0[rows, SIZE:QUAT] = np.sort(state.x0[rows, SIZE:QUAT], 1)  # in rising order, as along the new axes
    state.m[rows, :LOGIT] = 0  # because the momentum was along the old axes
    splats.means[rows], splats.scales[rows], splats.quats[rows] = means[rows], exp(x[rows, SIZE:QUAT]), quats


def _compute_cuts(splats: Splats, edges: Edges) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute how Gaussians would be cut at the edges.

    Returns their means ``[n,3]`` after the cut, their covariances ``[n,3,3]`` after the cut, and a mask ``[n]`` of the
    Gaussians that are cut. The covariances of all other Gaussians are not set.
    """
    count = len(splats.means)
    means, covars, is_cut = splats.means.copy(), np.empty((count, 3, 3)), np.zeros(count, np.uint8)

    def cut_rows(start: int) -> None:
        stop = min(start + ROWS, count)
        cut_at_edges(splats.quats, splats.scales, edges.normals, edges.offsets, start, stop, means, covars, is_cut)

    parallel_map(cut_rows, range(0, count, ROWS))
    return means, covars, is_cut.astype(bool)


def split_at_edges(state: FitState, edges: Edges, count: int) -> FitState:
    """Split Gaussians along the edges and drop halves beyond them, until the rim is narrow or there are ``count``.

    In each round the Gaussians with the widest soft borders are split. Returns a new state without moments, for the end
    of a fit. If no Gaussian is split, returns the given state.
    """
    # `candidates` are the rows of x that may be split: at first all Gaussians across an edge, later the halves of the
    # last round. `sources` are the rows of the state from which the rows of x come
    x = state.x
    candidates = np.flatnonzero(_compute_cuts(state.splats, edges)[2])
    sources = np.arange(len(x))
    is_split = np.zeros(len(x), bool)
    while len(x) < count:
        covars = covariances(
            x[candidates, QUAT:LOGIT].astype(np.float64), exp(x[candidates, SIZE:QUAT].astype(np.float64))
        )
        normals, distances, widths = _find_nearest_edges(x[candidates, :SIZE].astype(np.float64), covars, edges)
        edge_opacities = exp(-np.square(np.maximum(distances, 0)) / 2) / (
            1 + exp(-x[candidates, LOGIT].astype(np.float64))
        )
        is_shown = (edge_opacities > SHOWN) | is_split[candidates]
        soft = np.flatnonzero((np.abs(distances) < REACH) & (widths > SOFT) & is_shown)
        soft = soft[np.argsort(-widths[soft], kind="stable")[: count - len(x)]]
        if len(soft) == 0:
            break
        inner, outer = _split_across(x[candidates[soft]], covars[soft], normals[soft])
        stays = distances[soft] > 0  # all other outer halves are dropped, of which at most a sixth lies inside
        x = np.concatenate([x, outer[stays]])
        x[candidates[soft]] = inner
        is_split[candidates[soft]] = True
        sources = np.concatenate([sources, sources[candidates[soft[stays]]]])
        candidates = np.concatenate([candidates[soft], np.arange(len(is_split), len(x))])
        is_split = np.concatenate([is_split, np.ones(len(x) - len(is_split), bool)])
    if not is_split.any():
        return state
    split = state_of(x, state.splats.shN[sources])
    split.origins, split.min_sizes, split.fixed = state.origins[sources], state.min_sizes[sources], ~is_split
    cut_state(split, edges)
    return split


def _split_across(parents: np.ndarray, covars: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split Gaussians across planes; return the parameters ``[m,14]`` of the inner halves and of the outer halves.

    ``parents [m,14]`` are their parameters, ``covars [m,3,3]`` their covariances, and ``normals [m,3]`` point outward.
    """
    steps = matmul(covars, normals[..., None])[..., 0]
    steps *= OFFSET / np.sqrt((steps * normals).sum(1, keepdims=True))
    scales, quats = principal_axes(covars - steps[:, :, None] * steps[:, None, :])
    inner = parents.copy()
    inner[:, SIZE:QUAT], inner[:, QUAT:LOGIT], inner[:, LOGIT] = log(scales), quats, fade_halves(parents[:, LOGIT])
    outer = inner.copy()
    inner[:, :SIZE] -= steps
    outer[:, :SIZE] += steps
    return inner, outer


def _find_nearest_edges(
    means: np.ndarray, covars: np.ndarray, edges: Edges
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find, for each of n Gaussians, the nearest edge of the view in which the Gaussian lies deepest.

    Returns the outward normal ``[n,3]`` of the edge, the distance ``[n]`` of the mean from the edge in standard
    deviations of the Gaussian along the normal, positive inside, and the width ``[n]`` of the Gaussian's soft border as
    a share of the view's width. The kernel that cuts Gaussians chooses the edge by the same rule (``nearest_plane`` in
    edges.c), but does not return it.
    """
    rows = np.arange(len(means))
    deepest = np.full(len(means), -np.inf)
    cameras = edges.cameras
    nearest = np.zeros((len(means), 3))
    widths = np.zeros(len(means))
    for view, (normals, offsets) in enumerate(zip(edges.normals, edges.offsets, strict=True)):
        sigmas = np.sqrt((matmul(normals, covars) * normals).sum(2))  # [n,4]
        distances = (offsets - matmul(means, normals.T)) / sigmas
        edge = distances.argmin(1)
        deeper = distances[rows, edge] > deepest
        deepest[deeper], nearest[deeper] = distances[rows, edge][deeper], normals[edge][deeper]
        depths = np.maximum(camera_depths(means, cameras.viewmats[view].astype(np.float64)), 1e-9)
        soft = FALL * float(cameras.Ks[view, 0, 0]) / cameras.width * sigmas[rows, edge] / depths
        widths[deeper] = soft[deeper]
    return nearest, deepest, widths
