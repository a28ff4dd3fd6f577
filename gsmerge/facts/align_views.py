"""Aligned scene -> the same scene with cameras, and their pixels' Gaussians, moved to where the photos agree.

Poses that a network predicts are wrong by some pixels, and its Gaussians follow them: every view
fits itself and none of the others. The pixels of a view, at their depths, are looked up in the
photos of its neighbours, and all poses are moved at once until the greys agree: direct image
alignment (Engel et al., "Direct Sparse Odometry", 2018) with fixed depths, by Gauss-Newton steps on
small photos first. Scenes whose poses are right are left alone, bit for bit, after one step at the
smallest size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from gsmerge.geometry import (
    camera_depths,
    motion_matrices,
    motion_vectors,
    move_views,
    project,
    without_common_motion,
)
from gsmerge.kernels.elementary import log, log1p
from gsmerge.kernels.matrices import invert, matmul, solve
from gsmerge.kernels.pictures import blur, sample_bilinear
from gsmerge.raster.photos import NEAR, photos_of
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import PicturedScene

SIDES = (60, 120, 240)  # longer side of the photos, pixels, one after the other
MIN_SIDE = 24  # pixels of the shorter side at the first size, below which photos say too little
OVERLAP_SAMPLES = 400  # pixels of a view by which its neighbours are chosen
BORDER = 2  # pixels that no lookup goes near
SAMPLES = 1500  # pixels of a view that are looked up, those where the photo changes most
FIRST_SAMPLES, FIRST_STEPS = 600, 2  # the same, and the most steps, at the first size, which right poses pay for
NEIGHBOURS = 4  # views that a view is looked up in
MIN_OVERLAP = 0.2  # share of a view's pixels that a neighbour must see
MIN_SEEN = 50  # pixels that a pair of views must share
STEPS = 6  # most Gauss-Newton steps at each size
DAMPING = 1e-3  # of the curvature
EARLY_PX = 1.0  # motion after the first step up to which poses are taken for right
ENOUGH = 1e-4  # radians and canonical units: a smaller step ends them
BLUR = 0.7  # of the photos, standard deviation in pixels
SAME_DEPTH = 0.15  # logarithm of depths that may belong to one surface
DOUBT, MIN_DOUBT = 1.5, 0.01  # times the median residual from which on a pixel counts less; the least of it, grey
CLEAR = 0.03  # residual, grey, from which on what two poses leave is compared by its logarithm
PRIOR_TURN, PRIOR_SHIFT, PRIOR = 0.026, 0.03, 30.0  # radians and canonical units a pose is thought to be off; weight
LIMIT_PX = 1.5  # motion in the views, pixels, from which on poses count as wrong
# Share of what disagrees that the motion must take away besides: of some view at every size, and in the end more of it,
# or of all views. Wrong depth moves right views as well, for up to 0.14 of a view and 0.06 of all at the largest size,
# and a depth camera's own track 0.28 and 0.18. Views half a degree off gain 0.22 of all and more, one alone 0.32 of
# itself (14 captures). Those in between stay where they are: other photos of the scene are in the frame that was given.
LEAST_GAIN, VIEW_GAIN, MEAN_GAIN = 0.1, 0.3, 0.2


@dataclass(frozen=True, eq=False)
class _Level:
    """Photos at one size, with the sampled pixels of each view."""

    pictures: np.ndarray  # [v,h,w,3] float32: grey, and how it changes to the right and down
    Ks: np.ndarray  # [v,3,3]
    scale: float  # pixels of the views per pixel
    points: list[np.ndarray]  # [n,3] float64 of each view, in its camera's frame
    greys: list[np.ndarray]  # [n] of each
    depths: np.ndarray  # [v,h,w] of the Gaussians at the pixels' middles, canonical units; NaN where there is none
    start: np.ndarray  # [v,4,4] poses as they were given
    pairs: list[tuple[int, int]]  # a view, and one that it is looked up in


@dataclass(frozen=True, eq=False)
class _Pair:
    """Evidence from the pixels of one view about its pose relative to another view."""

    curvature: np.ndarray  # [6,6] of half the squared differences, by a motion of the second camera; the first's is its
    slope: np.ndarray  # [6]  # opposite, since only where one stands to the other counts
    cost: float  # mean over the pixels of how much they disagree
    flow: float  # median distance from where the given poses show them, pixels of the views


def align_views(scene: PicturedScene, views: Sequence[int], *, always: bool = False) -> PicturedScene | None:
    """Move every camera, with the Gaussians of its pixels, so that the photos agree with each other.

    ``views`` are the views whose photos show the scene; other views stay. With ``always`` even small errors are
    corrected. The median motion of the views is subtracted. Returns None if no pose is wrong, or if the photos cannot
    decide.
    """
    start = scene.cameras.viewmats.astype(np.float64)
    largest, shortest = (f(scene.cameras.width, scene.cameras.height) for f in (max, min))
    pairs = _choose_pairs(scene, views)
    sides = [side for side in SIDES if side < largest] or [largest]
    if not pairs or shortest * sides[0] < MIN_SIDE * largest:
        return None
    viewmats = start
    for side in sides:
        check = side == sides[0] != sides[-1] and not always
        level = _level_of(scene, pairs, largest / side, FIRST_SAMPLES if check else SAMPLES)
        viewmats, first, last = _descend(level, viewmats, check=check)
        before = first if side == sides[0] else parallel_map(partial(_compare, level, start), pairs)
        if not np.isfinite(viewmats).all() or not (always or _any_wrong(level, before, last, end=side == sides[-1])):
            return None
    placed = sorted({view for pair in pairs for view in pair})  # the others stay where they are
    viewmats[placed] = without_common_motion(start[placed], viewmats[placed], np.median)
    return move_views(scene, viewmats)


def _choose_pairs(scene: PicturedScene, views: Sequence[int]) -> list[tuple[int, int]]:
    """Choose pairs of views, in both orders: each view with the neighbours that see most of it."""
    cameras, means = scene.cameras, scene.gaussians.means.reshape(len(scene), -1, 3)
    step = max(1, scene.pixels_per_view // OVERLAP_SAMPLES)
    size, pairs, chosen = np.array([cameras.width, cameras.height]), set(), set(views)
    for view in views:
        xyz = means[view, ::step][scene.valid[view].reshape(-1)[::step]]
        pixels, z = project(xyz, cameras)
        seen = ((z > NEAR) & (pixels > 0).all(-1) & (pixels < size).all(-1)).mean(1) if len(xyz) else np.zeros(len(z))
        overlap = seen * matmul(cameras.viewmats[:, 2, :3], cameras.viewmats[view, 2, :3]).clip(0)
        ranked = [int(other) for other in np.argsort(-overlap, kind="stable") if other != view and other in chosen]
        for other in ranked[:NEIGHBOURS]:
            if overlap[other] > MIN_OVERLAP:
                pairs |= {(view, other), (other, view)}
    return sorted(pairs)


def _level_of(scene: PicturedScene, pairs: list[tuple[int, int]], level: float, samples: int) -> _Level:
    """Shrink the photos by ``level``, and sample pixels of each where it changes most."""
    photos = photos_of(scene.images, scene.cameras, level)
    shape = photos.height, photos.width
    rows, columns = ((np.arange(n) + 0.5) / n for n in shape)
    near = np.ix_((rows * scene.cameras.height).astype(int), (columns * scene.cameras.width).astype(int))
    means = scene.gaussians.means.reshape(*scene.valid.shape, 3)
    spread = 0.5 + np.random.default_rng(0).random(shape)  # or all pixels would be those of one edge
    spread[:BORDER] = spread[-BORDER:] = spread[:, :BORDER] = spread[:, -BORDER:] = 0

    def one_view(view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        grey = blur(photos.images[view].mean(-1, dtype=np.float32), BLUR)
        down, right = np.gradient(grey)
        depth = camera_depths(means[view][near], scene.cameras.viewmats[view])
        depth = np.where(scene.valid[view][near] & (depth > NEAR), depth, np.nan)
        score = np.where(np.isfinite(depth), np.sqrt(right * right + down * down) * spread, 0).ravel()
        chosen = np.argsort(-score, kind="stable")[:samples]
        chosen = chosen[score[chosen] > 0]
        y, x = np.divmod(chosen, photos.width)
        pixels = np.stack([x + 0.5, y + 0.5, np.ones(len(x))], 1)
        points = matmul(pixels, invert(photos.Ks[view]).T) * depth.ravel()[chosen, None]
        return np.stack([grey, right, down], -1), points, grey.ravel()[chosen], depth

    pictures, points, greys, depths = zip(*parallel_map(one_view, range(len(scene))), strict=True)
    scale, start = scene.cameras.width / photos.width, scene.cameras.viewmats.astype(np.float64)
    return _Level(np.stack(pictures), photos.Ks, scale, list(points), list(greys), np.stack(depths), start, pairs)


def _descend(level: _Level, viewmats: np.ndarray, *, check: bool) -> tuple[np.ndarray, list[_Pair], list[_Pair]]:
    """Improve poses by Gauss-Newton steps at one size; return the poses, and the pairs before and after.

    With ``check`` there are few steps, and only one if it moves no view far.
    """
    prior = PRIOR * np.tile(np.repeat([1 / PRIOR_TURN**2, 1 / PRIOR_SHIFT**2], 3), len(viewmats))
    first: list[_Pair] = []
    most = FIRST_STEPS if check else STEPS
    for step in range(most + 1):
        now = parallel_map(partial(_compare, level, viewmats), level.pairs)
        first = first or now
        if step == most or (check and step == 1 and _flows(level, now).max() < EARLY_PX):
            break
        curvature, slope = np.diag(prior), prior * motion_vectors(level.start, viewmats).ravel()
        for (a, b), comparison in zip(level.pairs, now, strict=True):
            rows, columns = slice(6 * a, 6 * a + 6), slice(6 * b, 6 * b + 6)
            for row, column, sign in ((rows, rows, 1), (columns, columns, 1), (rows, columns, -1), (columns, rows, -1)):
                curvature[row, column] += sign * comparison.curvature
            slope[rows] -= comparison.slope
            slope[columns] += comparison.slope
        curvature[np.diag_indices(len(curvature))] *= 1 + DAMPING
        change = -solve(curvature, slope).reshape(-1, 6)
        viewmats = matmul(viewmats, motion_matrices(change))
        if np.abs(change).max() < ENOUGH:
            break
    return viewmats, first, now


def _compare(level: _Level, viewmats: np.ndarray, pair: tuple[int, int]) -> _Pair:
    """Compare the pixels of one view with another view's photo, for the given poses."""
    (a, b), (height, width) = pair, level.pictures.shape[1:3]
    x, y, z, u, v, world = _look_up(level, viewmats, a, b)
    inside = (z > NEAR) & (u > BORDER) & (u < width - BORDER) & (v > BORDER) & (v < height - BORDER)
    rows, columns = v.clip(0, height - 1).astype(int), u.clip(0, width - 1).astype(int)
    inside &= np.abs(log(level.depths[b, rows, columns] / z)) < SAME_DEPTH  # not where there is none
    if inside.sum() < MIN_SEEN:
        return _Pair(np.zeros((6, 6)), np.zeros(6), 0.0, 0.0)
    first = _look_up(level, level.start, a, b)
    flow = level.scale * float(np.median(np.sqrt((u - first[3]) ** 2 + (v - first[4]) ** 2)[inside]))
    x, y, z, u, v, world = (values[inside] for values in (x, y, z, u, v, world))
    grey, right, down = sample_bilinear(level.pictures[b], u - 0.5, v - 0.5).T.astype(np.float64)
    residual = grey - level.greys[a][inside]
    residual -= np.median(residual)  # exposure
    doubt = max(MIN_DOUBT, DOUBT * float(np.median(np.abs(residual))))
    weights = 1 / (doubt**2 + residual**2)
    right, down = right * level.Ks[b, 0, 0] / z, down * level.Ks[b, 1, 1] / z
    slopes = matmul(np.stack([right, down, -(right * x + down * y)], 1), viewmats[b, :3, :3])  # by the world's axes
    columns = np.concatenate([np.cross(world, slopes), slopes], 1)
    weighted = columns * weights[:, None]
    cost = float(log1p((residual / CLEAR) ** 2).mean())
    return _Pair(matmul(weighted.T, columns), matmul(weighted.T, residual), cost, flow)


def _look_up(level: _Level, viewmats: np.ndarray, a: int, b: int) -> tuple[np.ndarray, ...]:
    """Project the pixels of view ``a`` into ``b``: x/z, y/z, z, u, v in pixels, and points ``[n,3]`` in the world."""
    world = matmul(level.points[a] - viewmats[a, :3, 3], viewmats[a, :3, :3])
    x, y, z = (matmul(world, viewmats[b, :3, :3].T) + viewmats[b, :3, 3]).T
    z, K = np.maximum(z, NEAR), level.Ks[b]
    return x / z, y / z, z, K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2], world


def _flows(level: _Level, pairs: list[_Pair]) -> np.ndarray:
    """Return the median motion ``[v]`` of the pixels of each view over its pairs, pixels."""
    both = list(zip(level.pairs, pairs, strict=True))
    flows = [[comparison.flow for pair, comparison in both if view in pair] for view in range(len(level.start))]
    return np.array([np.median(view_flows) if view_flows else 0.0 for view_flows in flows])


def _any_wrong(level: _Level, before: list[_Pair], last: list[_Pair], *, end: bool) -> bool:
    """Return whether a view moved far and now agrees better with the others, at the ``end`` much better."""
    far = _flows(level, last) > LIMIT_PX
    costs = np.zeros((2, len(far)))  # of each view, before and last
    for i, pairs in enumerate((before, last)):
        for pair, comparison in zip(level.pairs, pairs, strict=True):
            costs[i, list(pair)] += comparison.cost
    gains = 1 - costs[1] / np.maximum(costs[0], 1e-9)
    all_gain = 1 - costs[1].sum() / max(costs[0].sum(), 1e-9)
    if end:
        return bool((far & (gains > VIEW_GAIN)).any() or (far.any() and all_gain > MEAN_GAIN))
    return bool((far & (gains > LEAST_GAIN)).any())
