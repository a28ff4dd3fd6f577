"""Scene -> the scene with its cameras, and the Gaussians of their pixels, moved to poses at which the photos agree.

Poses that a network predicts are wrong by some pixels. The Gaussians of a view have the same error as its pose, so
every view agrees with itself but not with other views. The pixels of a view, at their depths, are projected into the
photos of its neighbours. All poses are moved at once until the greys of both photos agree. The method is direct image
alignment (Engel et al., "Direct Sparse Odometry", 2018) with fixed depths, by Gauss-Newton steps, on small photos
first. If the first step on the smallest photos hardly moves the poses, they are right, and the scene stays unchanged
bit for bit.

Highlights move over their surfaces with the camera, and so look like wrong poses. The comparison of greys therefore
expects the changes of colour that the harmonics describe. New poses are kept only if the fine detail of the photos
agrees no worse than with the old poses.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmerge.frozen import dataclass
from gsmerge.method.geometry.transforms import (
    camera_depths,
    median,
    motion_matrices,
    motion_vectors,
    move_views,
    without_common_motion,
)
from gsmerge.method.kernels.matrices import invert, matmul, solve
from gsmerge.method.kernels.pictures import blur
from gsmerge.method.kernels.raster.project import view_colors
from gsmerge.method.kernels.reproject import SCRATCH_COLUMNS, compare_views, see_points
from gsmerge.method.raster.photos import NEAR_PLANE, photos_of
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import PicturedScene

SIDES = (60, 120, 240)  # longer side of the photos in pixels, one size after the other
BORDER = 2  # width in pixels of the border that is not compared
POSE_PIXELS = 1500  # compared pixels of a view, those with the largest gradients
# Compared pixels of a view, and largest number of steps, at the smallest size of the photos. Scenes with right poses
# get no further steps, so few pixels and steps save time
FIRST_PIXELS = 600
FIRST_STEPS = 2
POSE_NEIGHBOURS = 4  # number of other views with which a view is compared
POSE_STEPS = 6  # largest number of Gauss-Newton steps at each size
TOGETHER = 16  # pairs of views that one task compares
POSE_BLUR = 0.7  # blur of the photos, standard deviation in pixels
# Detail of photos is finer than the blur DETAIL, in pixels. Highlights are smooth. If highlights mislead the new poses,
# the detail of surfaces agrees less than with the old poses. New poses are dropped if detail agrees less by more than
# CHANCE standard errors
DETAIL = 2.0
CHANCE = 2.0
# Errors of poses are assumed to have the standard deviations PRIOR_TURN in radians and PRIOR_SHIFT in canonical units.
# PRIOR is the weight of this assumption beside the photos
PRIOR_TURN = 0.026
PRIOR_SHIFT = 0.03
PRIOR = 30.0
# The gain of a view is the share of its photos' disagreement that new poses remove. Poses are moved only if some view
# has a gain above LEAST_GAIN at every size. At the largest size, the gain of some view must also be above VIEW_GAIN, or
# the gain of all views together above MEAN_GAIN. Right poses have gains, too, if the depth is wrong. At the largest
# size, gains of right poses are up to 0.14 for a view and 0.06 for all views together. Poses of a depth camera have
# gains up to 0.28 for a view and 0.18 for all. If all poses are wrong by half a degree, the gain of all views is at
# least 0.22. If a single pose is wrong, the gain of its view is 0.32 (measured on 14 captures). In doubt the poses are
# not moved, because photos outside the scene have poses in the same frame as the input
LEAST_GAIN = 0.1
VIEW_GAIN = 0.3
MEAN_GAIN = 0.2


@dataclass(frozen=True, eq=False)
class _PhotoLevel:
    """Photos at one size, with the sampled pixels of each view."""

    pictures: np.ndarray  # [v,h,w,3] float32, grey, and its slope to the right and down
    Ks: np.ndarray  # [v,3,3]
    scale: float  # Pixels of a view per pixel of these photos, along each axis
    points: np.ndarray  # [n,3] float64, sampled points of all views, in their cameras' frames
    greys: np.ndarray  # [p,m] float32, greys that the second view of a pair should show at the points of the first
    starts: np.ndarray  # [v+1] index of the first point of each view
    depths: np.ndarray  # [v,h,w] depths of the Gaussians at the pixels' middles, canonical units; NaN for none
    first_viewmats: np.ndarray  # [v,4,4] poses of the input
    pairs: np.ndarray  # [p,2] a view, and the view in which it is looked up


@dataclass(frozen=True, eq=False)
class _Evidence:
    """Evidence about the relative poses of p pairs of views, from the pixels of each pair's first view."""

    # Curvature and slope of half the squared differences of greys, by a motion of the second view. Only the relative
    # pose counts, so the same motion of the first view changes the differences the other way
    curvatures: np.ndarray  # [p,6,6]
    slopes: np.ndarray  # [p,6]
    costs: np.ndarray  # [p] mean disagreement of the pixels
    flows: np.ndarray  # [p] median shift of the pixels since the poses of the input, in pixels of the views


def move_poses(scene: PicturedScene, views: Sequence[int], *, always: bool = False) -> PicturedScene | None:
    """Move every camera, with the Gaussians of its pixels, so that the photos agree with each other.

    Only ``views``, whose photos show the scene, are moved. With ``always``, the cameras are moved even if the photos
    then hardly agree better. The median motion of the views is subtracted from all motions, so that the scene as a
    whole stays in place. Returns None if no pose is wrong, if the photos are too small or do not overlap, or if the
    detail of the photos agrees less after the move.
    """
    start = scene.cameras.viewmats.astype(np.float64)
    largest, shortest = (f(scene.cameras.width, scene.cameras.height) for f in (max, min))
    pairs = _choose_pairs(scene, views)
    sides = [side for side in SIDES if side < largest] or [largest]
    limit_px = 1.5  # a pose counts as wrong if it moves by more than this, in pixels of the views
    min_side = 24  # pixels of the shorter side at the first size; smaller photos say too little
    if len(pairs) == 0 or shortest * sides[0] < min_side * largest:
        return None
    viewmats = start
    for side in sides:
        check = side == sides[0] != sides[-1] and not always  # the first size decides whether poses may be wrong
        level = _make_level(scene, pairs, largest / side, FIRST_PIXELS if check else POSE_PIXELS)
        viewmats, final = _improve_poses(level, viewmats, check=check)
        if not np.isfinite(viewmats).all():
            return None
        if always:
            continue
        # A pose is wrong if its view moved far, and now agrees better with other views. At the largest size, such a
        # view has to agree much better, or all views together have to agree better
        is_far = _view_flows(level, final) > limit_px
        costs_before, costs = (
            np.bincount(level.pairs.ravel(), evidence.costs.repeat(2), len(is_far))
            for evidence in (_gather_evidence(level, start), final)
        )
        gains = 1 - costs / np.maximum(costs_before, 1e-9)
        mean_gain = 1 - costs.sum() / max(costs_before.sum(), 1e-9)
        is_last = side == sides[-1]
        is_wrong = (is_far & (gains > (VIEW_GAIN if is_last else LEAST_GAIN))).any()
        if not is_wrong and not (is_last and is_far.any() and mean_gain > MEAN_GAIN):
            return None
    detail = _make_level(scene, pairs, largest / sides[-1], POSE_PIXELS, detail=True)
    worse = _gather_evidence(detail, viewmats).costs - _gather_evidence(detail, start).costs
    if not always and worse.sum() > CHANCE * np.sqrt((worse * worse).sum()):
        return None
    moved = np.unique(pairs)  # all other views keep their poses
    viewmats[moved] = without_common_motion(start[moved], viewmats[moved], np.median)
    return move_views(scene, viewmats)


def _choose_pairs(scene: PicturedScene, views: Sequence[int]) -> np.ndarray:
    """Choose pairs of views ``[p,2]``, in both orders: each view with the neighbours that it overlaps most."""
    cameras = scene.cameras
    fronts = scene.get_pixels().fronts.reshape(len(scene), -1)
    overlap_pixels = 400  # the neighbours of a view are chosen by about this many of its pixels
    step = max(1, scene.pixels_per_view // overlap_pixels)
    viewmats = cameras.viewmats.astype(np.float64)
    Ks = cameras.Ks.astype(np.float64)
    pairs = set()
    candidates = set(views)
    anywhere = np.full((len(scene), 1, 1), np.inf)
    min_overlap = 0.2  # share of a view's pixels that a neighbour must see
    for view in views:
        rows = fronts[view, ::step]
        points = scene.gaussians.means[rows[rows >= 0]].astype(np.float64)
        inside, _ = see_points(points, viewmats, Ks, anywhere, cameras.width, cameras.height, NEAR_PLANE, 1.0)
        seen_shares = inside.mean(1) if len(points) else np.zeros(len(inside))
        cosines = matmul(cameras.viewmats[:, 2, :3], cameras.viewmats[view, 2, :3])  # between viewing directions
        overlap = seen_shares * cosines.clip(0)
        ranked = [int(i) for i in np.argsort(-overlap, kind="stable") if i != view and i in candidates]
        for neighbour in ranked[:POSE_NEIGHBOURS]:
            if overlap[neighbour] > min_overlap:
                pairs |= {(view, neighbour), (neighbour, view)}
    return np.array(sorted(pairs), np.int64)


def _make_level(
    scene: PicturedScene, pairs: np.ndarray, factor: float, samples: int, *, detail: bool = False
) -> _PhotoLevel:
    """Shrink the photos by ``factor``, and choose at most ``samples`` pixels of each photo with large gradients.

    With ``detail``, each photo is replaced by its difference from a blurred copy. ``pairs [p,2]`` are the views to
    compare.
    """
    photos = photos_of(scene.images, scene.cameras, factor)
    shape = photos.height, photos.width
    rows, columns = ((np.arange(n) + 0.5) / n for n in shape)
    nearest = np.ix_((rows * scene.cameras.height).astype(int), (columns * scene.cameras.width).astype(int))
    means, fronts = scene.gaussians.means, scene.get_pixels().fronts
    spread = 0.5 + np.random.default_rng(0).random(shape)  # so that chosen pixels do not all lie on one edge
    spread[:BORDER] = spread[-BORDER:] = spread[:, :BORDER] = spread[:, -BORDER:] = 0

    def sample_view(view: int) -> tuple[np.ndarray, ...]:
        """Return the picture of a view, the points, greys and Gaussians of its sampled pixels, and all its depths."""
        grey = photos.images[view].mean(-1, dtype=np.float32)
        grey = blur(grey, POSE_BLUR) - (blur(grey, DETAIL) if detail else np.float32(0))
        down, right = np.gradient(grey)
        rows = fronts[view][nearest]
        depth = camera_depths(means[rows], scene.cameras.viewmats[view])
        depth = np.where((rows >= 0) & (depth > NEAR_PLANE), depth, np.nan)
        score = np.where(np.isfinite(depth), np.sqrt(right * right + down * down) * spread, 0).ravel()
        ids = np.argsort(-score, kind="stable")[:samples]
        ids = ids[score[ids] > 0]
        y, x = np.divmod(ids, photos.width)
        pixels = np.stack([x + 0.5, y + 0.5, np.ones(len(x))], 1)
        points = matmul(pixels, invert(photos.Ks[view]).T) * depth.ravel()[ids, None]
        return np.stack([grey, right, down], -1), points, grey.ravel()[ids], rows.ravel()[ids], depth

    pictures, points, greys, ids, depths = zip(*parallel_map(sample_view, range(len(scene))), strict=True)
    # The second view of a pair should show the greys of the first, plus the change of colour of the Gaussians from the
    # first view to the second. Without this change, a highlight would look like a wrong pose, because it moves over its
    # surface with the camera
    g = scene.gaussians
    eyes = scene.cameras.centres.astype(np.float32)
    expected = np.zeros((len(pairs), max(map(len, greys))), np.float32)
    for expected_greys, (first, second) in zip(expected, pairs, strict=True):
        count = len(ids[first])
        shown = [np.ascontiguousarray(column[ids[first]], np.float32) for column in (g.means, g.sh0, g.shN)]
        shown.append(np.arange(count, dtype=np.int32))
        first_colors, second_colors = np.empty((2, count, 3), np.float32)
        view_colors(*shown, eyes[first], 0, count, first_colors)
        view_colors(*shown, eyes[second], 0, count, second_colors)
        changes = second_colors.clip(max=1) - first_colors.clip(max=1)  # photos show nothing brighter than 1
        expected_greys[:count] = greys[first] + changes.mean(1)
    return _PhotoLevel(
        pictures=np.stack(pictures),
        Ks=photos.Ks.astype(np.float64),
        scale=scene.cameras.width / photos.width,
        points=np.concatenate(points),
        greys=expected,
        starts=np.cumsum([0, *map(len, greys)]),
        depths=np.stack(depths),
        first_viewmats=scene.cameras.viewmats.astype(np.float64),
        pairs=pairs,
    )


def _improve_poses(level: _PhotoLevel, viewmats: np.ndarray, *, check: bool) -> tuple[np.ndarray, _Evidence]:
    """Improve poses by Gauss-Newton steps at one size; return the new poses, and the evidence at the new poses.

    Each step solves the normal equations of all pairs and of the prior. With ``check``, at most FIRST_STEPS steps are
    taken, and only one step if it shows that the poses are right.
    """
    max_steps = FIRST_STEPS if check else POSE_STEPS
    right_px = 1.0  # poses are considered right if the first step moves all views by less than this, in pixels
    min_step = 1e-4  # a smaller step, in radians and canonical units, is the last
    damping = 1e-3  # damping of the steps, relative to the curvature
    prior = PRIOR * np.tile(np.repeat([1 / PRIOR_TURN**2, 1 / PRIOR_SHIFT**2], 3), len(viewmats))
    for step in range(max_steps + 1):
        evidence = _gather_evidence(level, viewmats)
        if step == max_steps or (check and step == 1 and _view_flows(level, evidence).max() < right_px):
            break
        curvature = np.diag(prior)
        slope = prior * motion_vectors(level.first_viewmats, viewmats).ravel()
        pairs = zip(level.pairs.tolist(), evidence.curvatures, evidence.slopes, strict=True)
        for (view, other), pair_curvature, pair_slope in pairs:
            # the motions of both views
            a = slice(6 * view, 6 * view + 6)
            b = slice(6 * other, 6 * other + 6)
            for rows, columns, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
                curvature[rows, columns] += sign * pair_curvature
            slope[a] -= pair_slope
            slope[b] += pair_slope
        curvature[np.diag_indices(len(curvature))] *= 1 + damping
        change = -solve(curvature, slope).reshape(-1, 6)  # next motion of each view
        viewmats = matmul(viewmats, motion_matrices(change))
        if np.abs(change).max() < min_step:
            break
    return viewmats, evidence


def _gather_evidence(level: _PhotoLevel, viewmats: np.ndarray) -> _Evidence:
    """Compare the pixels of the first view of each pair with the photo of the second view, at poses ``viewmats``."""
    count, max_points = level.greys.shape
    evidence = _Evidence(np.empty((count, 6, 6)), np.empty((count, 6)), np.empty(count), np.empty(count))

    def compare_pairs(begin: int) -> None:
        """Fill the evidence of a few pairs, from number ``begin`` on."""
        scratch = np.empty((SCRATCH_COLUMNS, max_points))
        scratch_ids = np.empty(max_points, np.int64)
        compare_views(
            level.points, level.greys, starts=level.starts, pairs=level.pairs, viewmats=viewmats,
            given=level.first_viewmats, Ks=level.Ks, pictures=level.pictures, depths=level.depths, near=NEAR_PLANE,
            border=BORDER, scale=level.scale, first=begin, last=min(begin + TOGETHER, count), scratch=scratch,
            order=scratch_ids, curvatures=evidence.curvatures, slopes=evidence.slopes, costs=evidence.costs,
            flows=evidence.flows,
        )  # fmt: skip

    parallel_map(compare_pairs, range(0, count, TOGETHER))
    return evidence


def _view_flows(level: _PhotoLevel, evidence: _Evidence) -> np.ndarray:
    """Return the shift ``[v]``, pixels, of each view's points since the input: the median of the view's pairs."""
    flows = [evidence.flows[(level.pairs == view).any(1)] for view in range(len(level.first_viewmats))]
    return np.array([median(view_flows) if len(view_flows) else 0.0 for view_flows in flows])
