"""Score how near Gaussians project to their pixels, from cameras that may stand in another frame.

A Gaussian lies on the ray of its pixel: ``(x - c) x d = 0`` with the camera's centre c and the ray's direction d.
The Gaussians stay in place; the cameras are moved.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmerge.alignment.layouts import Layout, plain_layout, subsample
from gsmerge.alignment.resection import projection_errors, refine_poses, start_pose
from gsmerge.geometry import IDENTITY, Similarity, camera_centres, median, robust_weights, sh0_to_rgb
from gsmerge.kernels import reproject
from gsmerge.kernels.elementary import arccos, log
from gsmerge.kernels.matrices import closest_rotation, eigh, invert, matmul, solve_symmetric
from gsmerge.runtime.memory import free_pages, gather
from gsmerge.types import Cameras, Gaussians

MARGIN = 2.0  # by which the best reading must beat the next one
SHUFFLED_MARGIN = 5.0  # and by which it must beat shuffled pixels
SMALLEST_PX = 1e-3  # distances are compared as if none were smaller, pixels
QUICK_SAMPLES, SAMPLES, MIN_SAMPLES = 1500, 6000, 60  # Gaussians of a score; per view at least
MAX_CHECKED = 5_000  # pixels per view that an alignment is checked on
MAX_MEDIAN_PX = 1.5  # backbones move a Gaussian within its pixel, and some a little beyond
_ROUNDS = 4  # of reweighted least squares
_MAX_POINTS = 2000  # that a camera's pose is solved from
_SAME_TURN = 0.01  # of rotation matrices that differ by errors alone
_SMALL_ROTATION, _SMALL_SCALE = 10.0, 0.05  # degrees, and natural logarithm
_AS_GOOD, _AS_GOOD_PX = 1.5, 0.05  # one similarity for all cameras, compared with a pose for each


_HALF = np.sqrt(0.5)
# As the pixelSplat family turns its world: axes swapped, then an eighth of a turn about the last one.
UPRIGHT = np.array([[-_HALF, 0, _HALF], [-_HALF, 0, -_HALF], [0, -1, 0]])


def scale_by(scale: float, note: str = "") -> Similarity:
    """Return the similarity that only changes the unit."""
    text = f"positions scaled by {scale:.4g}{note}"
    return Similarity(np.eye(3), scale, np.zeros(3), text, "scaled")


@dataclass(frozen=True)
class Correspondences:
    """t Gaussians with the view and the pixel that each is assumed to belong to."""

    points: np.ndarray  # ``[t,3]`` float64 means
    pixels: np.ndarray  # ``[t,2]`` pixel centres (x, y)
    views: np.ndarray  # ``[t]`` rows of the camera arrays
    parts: np.ndarray  # ``[t]`` what wrote them, in order: a view, or one layer of it
    rows: np.ndarray  # ``[t]`` of the file

    def select(self, index: np.ndarray) -> Correspondences:
        """Select rows by a mask or indices."""
        return Correspondences(*(column[index] for column in vars(self).values()))

    def split(self, values: np.ndarray, parts: int) -> list[np.ndarray]:
        """Split ``values [t,...]`` into one array per part."""
        return np.split(values, np.cumsum(np.bincount(self.parts, minlength=parts))[:-1])


def pixel_errors(pairs: Correspondences, cameras: Cameras) -> np.ndarray:
    """Measure the distances ``[t]``, pixels, of projected Gaussians from their pixel centres; inf behind a camera."""
    errors = np.empty(len(pairs.views))
    values = pairs.points, cameras.viewmats, cameras.Ks, pairs.pixels
    points, viewmats, Ks, pixels = (np.ascontiguousarray(array, np.float64) for array in values)
    reproject.pixel_errors(points, np.ascontiguousarray(pairs.views, np.int64), viewmats, Ks, pixels, errors)
    return errors


def ray_directions(pairs: Correspondences, cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Compute unit directions ``[t,3]`` and origins ``[t,3]`` of the pixels' rays in the cameras' world."""
    ones = np.ones((len(pairs.pixels), 1))
    inverse = invert(cameras.Ks)[pairs.views]
    local = _apply(inverse, np.concatenate([pairs.pixels, ones], 1))
    rays = _apply(cameras.viewmats[pairs.views, :3, :3].swapaxes(1, 2), local)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True), camera_centres(cameras.viewmats)[pairs.views]


def _apply(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Apply matrices ``[t,3,3]`` to vectors ``[t,3]``, one to one."""
    return matmul(matrices, vectors[:, :, None])[..., 0]


def candidate_similarities(
    pairs: Correspondences | None, cameras: Cameras, *, scale: float | None = None, effort: int = 2
) -> Iterator[Similarity]:
    """Yield similarities that may map the frame of the cameras to that of the Gaussians, the plausible ones first.

    They are: the same frame; a scale; the frame of the first or the middle camera, alone, scaled, or scaled and
    shifted; any similarity, from poses solved from the pixels. ``scale``: size of the Gaussians' world in units of the
    cameras', if known. ``effort`` 0 solves for nothing (``pairs`` may be None), 1 for scale and shift, 2 also for the
    rotation.
    """
    yield IDENTITY if scale is None else scale_by(scale, ", as given")
    rays = None if pairs is None or effort == 0 else ray_directions(pairs, cameras)
    first, middle = cameras.viewmats[0, :3, :3], cameras.viewmats[len(cameras) // 2, :3, :3]
    rotations = (
        (np.eye(3), "", ""),
        (first, "rotated into the first camera", "first"),
        (middle, "rotated into the middle camera", "middle"),
        (matmul(UPRIGHT, first), "rotated upright from the first camera", "upright"),
    )
    for rotation, name, kind in rotations:
        if name:
            yield Similarity(rotation, scale or 1.0, np.zeros(3), name, kind)
        if pairs is None or rays is None:
            continue
        for shifted in (False, True) if scale is None else (True,):
            frame = solve_frame(pairs.points, rays, rotation, shifted=shifted)
            if frame is not None:
                text = f"positions scaled by {frame.scale:.4g}" + (" and shifted" if shifted else "")
                text = f"{name}, {text}" if name else text
                yield replace(frame, description=text, kind=kind or ("shifted" if shifted else "scaled"))
    if pairs is None or rays is None or effort < 2:
        return
    free = _mean_rotation(_solve_poses(pairs, cameras.Ks), cameras.viewmats)
    frame = None if free is None else solve_frame(pairs.points, rays, free, shifted=True)
    if frame is not None:
        angle = np.degrees(arccos(np.clip((np.trace(frame.rotation) - 1) / 2, -1, 1)))
        if angle < _SMALL_ROTATION and abs(log(frame.scale)) < _SMALL_SCALE:
            return  # no exporter does so: the cameras are inexact, and a rotation hides it
        turned = (matmul(UPRIGHT, viewmat[:3, :3]) for viewmat in cameras.viewmats)
        upright = any(np.abs(rotation - free).max() < _SAME_TURN for rotation in turned)
        name = "rotated upright" if upright else f"rotated by {angle:.1f} degrees"
        text = f"{name}, positions scaled by {frame.scale:.4g} and shifted"
        yield replace(frame, description=text, kind="upright" if upright else "other")


def solve_frame(
    points: np.ndarray, rays_and_centres: tuple[np.ndarray, np.ndarray], rotation: np.ndarray, *, shifted: bool
) -> Similarity | None:
    """Solve robustly for scale and shift that bring rotated points nearest to their rays.

    The scale is None if it is not positive.
    """
    rays, centres = (matmul(part, rotation.T) for part in rays_and_centres)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    columns = [_apply(across, centres)[:, :, None]] + ([across] if shifted else [])
    A, b = np.concatenate(columns, 2), _apply(across, points)
    weights, solution = np.ones(len(points)), np.zeros(A.shape[2])
    for _ in range(_ROUNDS):
        heavy = (A * weights[:, None, None]).reshape(-1, A.shape[2])
        left, right = matmul(heavy.T, A.reshape(-1, A.shape[2])), matmul(heavy.T, b.reshape(-1))
        unit = np.sqrt(np.maximum(np.diag(left), 1e-300))
        solution = solve_symmetric(left / np.outer(unit, unit), right / unit) / unit
        if not np.isfinite(solution).all() or solution[0] <= 0:
            return None
        shift = solution[1:] if shifted else np.zeros(3)
        away = points - solution[0] * centres - shift
        depth = np.abs((away * rays).sum(1)) + 1e-12
        angle = np.linalg.norm(_apply(across, away), axis=1) / depth
        weights = robust_weights(angle, 3, 1e-12, depth)
    return Similarity(rotation, float(solution[0]), shift)


def _solve_poses(pairs: Correspondences, Ks: np.ndarray) -> dict[int, np.ndarray]:
    """Solve for the pose of each view from only its own pixels."""
    poses = ((int(view), solve_pose(pairs, int(view), Ks[view])) for view in np.unique(pairs.views))
    return {view: pose for view, pose in poses if pose is not None}


def _mean_rotation(poses: dict[int, np.ndarray], viewmats: np.ndarray) -> np.ndarray | None:
    """Average the rotations between the two frames; None where the views disagree."""
    if not poses:
        return None
    mean = np.mean([matmul(pose[:3, :3].T, viewmats[view, :3, :3]) for view, pose in poses.items()], 0)
    squares, _ = eigh(matmul(mean.T, mean))
    if squares[0] < 0.9**2:  # rotations that agree have a mean that is nearly one
        return None
    return closest_rotation(mean)


def fits_all_cameras(frame: Similarity, pairs: Correspondences, cameras: Cameras) -> bool:
    """Return whether one similarity fits about as well as a separate pose per camera; otherwise cameras are wrong."""
    viewmats = cameras.viewmats.copy()
    for view, pose in _solve_poses(pairs, cameras.Ks).items():
        viewmats[view] = pose
    best = median(pixel_errors(pairs, replace(cameras, viewmats=viewmats)))
    return median(pixel_errors(pairs, frame.move(cameras))) <= max(_AS_GOOD * best, best + _AS_GOOD_PX)


def solve_pose(pairs: Correspondences, view: int, K: np.ndarray) -> np.ndarray | None:
    """Solve for one view's world-to-camera matrix ``[4,4]`` in the frame of the Gaussians from only its own pixels."""
    rows = np.flatnonzero(pairs.views == view)
    rows = rows[:: max(1, len(rows) // _MAX_POINTS)]
    if len(rows) < 6:
        return None
    points, pixels = pairs.points[rows], pairs.pixels[rows]
    middle, unit = np.median(points, 0), float(np.median(np.abs(points - np.median(points, 0)))) or 1.0
    near, K = (points - middle) / unit, K.astype(np.float64)
    for _ in range(2):
        start = start_pose(near, pixels, K)
        if start is None:
            return None
        pose = start
        error = projection_errors(near, pixels, K, pose)
        good = error <= max(1.0, 3 * float(np.median(error)))
        near, pixels = near[good], pixels[good]
    try:
        _, (pose,) = refine_poses([near], [pixels], K, pose[None])
    except np.linalg.LinAlgError:  # points in one place
        return None
    pose[:3, 3] = unit * pose[:3, 3] - matmul(pose[:3, :3], middle)
    return pose if np.isfinite(pose).all() else None


@dataclass(frozen=True)
class AlignmentInput:
    """Input of the search for pixels: rows, cameras, photos and hints."""

    gaussians: Gaussians  # the file's n rows
    valid: np.ndarray  # ``[n]`` bool
    cameras: Cameras  # all c cameras at the grid's size, in their own world
    images: np.ndarray  # ``[c,h,w,3]`` photos; [0,...] without any
    labellings: Sequence[tuple[int, ...]]  # orders that the views may be in: the file's, that of the names
    # reads ``[c,h,w]`` depth maps next to the cameras; None where there are none
    depths: Callable[[], np.ndarray | None]
    order: str = "auto"  # the order of the rows where it is given, otherwise "auto"
    scale: float | None = None  # size of the Gaussians' world in units of the cameras', where it is given
    # finds the grid of rows that lack pixels, and cameras for it; None where there is none
    dropped: Callable[[], tuple[Layout, Cameras] | None] = lambda: None

    def pairs(self, layout: Layout) -> Correspondences:
        """Return the valid rows of a layout with their pixels and views."""
        return find_correspondences(self.gaussians.means, self.valid, layout)


def find_correspondences(means: np.ndarray, valid: np.ndarray, layout: Layout) -> Correspondences:
    """Return the valid rows of a layout (``means [n,3]``, ``valid [n]``) with their pixels and views."""
    rows, pixels = np.concatenate(layout.rows), np.concatenate(layout.pixels)
    parts = np.repeat(np.arange(len(layout.views)), [len(part_rows) for part_rows in layout.rows])
    good = valid[rows]
    rows, pixels, parts = rows[good], pixels[good], parts[good]
    y, x = np.divmod(pixels, layout.width)
    points = gather(means, rows).astype(np.float64)
    return Correspondences(points, np.stack([x, y], 1) + 0.5, np.array(layout.views)[parts], parts, rows)


@dataclass(frozen=True)
class Reading:
    """One assumption about which pixel each row belongs to, and how well it fits."""

    layout: Layout  # which row belongs to which pixel
    frame: Similarity  # from the frame of the cameras to that of the Gaussians
    median_px: float  # median distance of the projected Gaussians from their pixels; inf where most are behind
    worst_px: float  # the same of the worst view
    ok: bool  # whether it is near enough to be true
    quick: bool = False  # whether it was scored, and its frame solved, on few Gaussians

    @property
    def description(self) -> str:
        """Description of the reading in words."""
        return ", ".join(part for part in (self.layout.description, self.frame.description) if part)


def pixel_limit(width: int, height: int) -> float:
    """Return the largest median distance, pixels, at which Gaussians still count as belonging to their pixels."""
    return max(0.5, min(MAX_MEDIAN_PX, 0.1 * math.sqrt(width * height)))


def sample_layout(layout: Layout, samples: int = SAMPLES) -> Layout:
    """Thin a layout to a sample of rows for scoring."""
    return subsample(layout, max(MIN_SAMPLES, samples // len(layout.views)))


def score_layout(
    inputs: AlignmentInput, layout: Layout, frame: Similarity, pairs: Correspondences | None = None
) -> Reading:
    """Score how well a layout fits in a frame, on a sample of its rows or on the given ``pairs``."""
    if pairs is None:
        pairs = inputs.pairs(sample_layout(layout))
    errors = pixel_errors(pairs, frame.move(inputs.cameras))
    medians = [median(part) for part in pairs.split(errors, len(layout.views)) if len(part)]
    middle, worst = median(errors) if len(errors) else math.inf, max(medians, default=math.inf)
    ok = bool(medians) and worst < pixel_limit(layout.width, layout.height) and bool(np.isfinite(errors).mean() > 0.5)
    return Reading(layout, frame, middle, worst, ok)


def score_shuffled(inputs: AlignmentInput, best: Reading) -> tuple[float, float]:
    """Measure median distance (pixels) and mean colour distance with pixels shuffled in each part, for comparison."""
    rng, layout = np.random.default_rng(0), sample_layout(best.layout)
    pairs = inputs.pairs(replace(layout, pixels=tuple(rng.permutation(pixels) for pixels in layout.pixels)))
    errors = pixel_errors(pairs, best.frame.move(inputs.cameras))
    return median(errors), _color_distance(inputs, pairs)


def beats_shuffled(reading: Reading, shuffled_px: float) -> bool:
    """Return whether a reading is near enough to its pixels, and far nearer than to shuffled pixels."""
    return reading.ok and shuffled_px >= SHUFFLED_MARGIN * max(reading.worst_px, SMALLEST_PX)


def color_error(inputs: AlignmentInput, layout: Layout) -> float:
    """Measure the mean distance, 0 to 1, between base colours and photos at a layout's pixels; NaN without either."""
    return _color_distance(inputs, inputs.pairs(sample_layout(layout)))


def _color_distance(inputs: AlignmentInput, pairs: Correspondences) -> float:
    if not len(pairs.rows):
        return math.nan
    base = sh0_to_rgb(gather(inputs.gaussians.sh0, pairs.rows)[:, 0])
    if (base == base[0]).all():  # depth maps without images
        return math.nan
    x, y = pairs.pixels.astype(np.int64).T
    colors = photo_colors(inputs.images, pairs.views, y, x)
    return float(np.abs(base.clip(0, 1) - colors).mean(1).mean())


def photo_colors(images: np.ndarray, views: np.ndarray, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Look up the colours ``[t,3]`` of photos ``[c,h,w,3]`` at the given pixels; NaN without photos."""
    return gather(images, views, y, x) if len(images) else np.full((len(x), 3), np.nan, np.float32)


@dataclass(frozen=True)
class Alignment:
    """Distances between the pixels of each view and the projections of their Gaussians."""

    # median distance from the pixel centre per view, pixels; inf where most are behind the camera, NaN where a view has
    # no finite Gaussian
    median_px: tuple[float, ...]
    share_in_front: float  # share of all checked Gaussians with positive depth in their own view
    share_within_1px: float  # share of all checked Gaussians at most one pixel from their pixel's centre
    limit_px: float  # largest median that counts as aligned
    ok: bool  # whether every view's median is below the limit and most Gaussians are in front

    @property
    def worst_px(self) -> float:
        """Largest of the views' median distances, pixels."""
        return max((m for m in self.median_px if not math.isnan(m)), default=math.nan)


def check_alignment(gaussians: Gaussians, cameras: Cameras, valid: np.ndarray) -> Alignment:
    """Measure how far a sample of Gaussians in every view projects from their own pixels.

    ``gaussians`` are V·H·W rows in view-major, row-major order; rows that are False in ``valid [V·H·W]`` (or
    ``[V,H,W]``) are left out. ValueError for another number of rows.
    """
    free_pages(vars(gaussians).values())
    return check_pairs(sample_pixels(gaussians, cameras, valid), cameras)


def sample_pixels(gaussians: Gaussians, cameras: Cameras, valid: np.ndarray) -> Correspondences:
    """Return the sample of Gaussians and pixels that :func:`check_alignment` measures."""
    views, width, height = len(cameras), cameras.width, cameras.height
    if len(gaussians) != views * height * width:
        raise ValueError(f"expected {views} x {height} x {width} Gaussians, got {len(gaussians)}")
    layout = plain_layout(views, width, height)
    return find_correspondences(gaussians.means, valid.reshape(-1), subsample(layout, MAX_CHECKED))


def check_pairs(pairs: Correspondences, cameras: Cameras) -> Alignment:
    """Measure a sample with other cameras, as :func:`check_alignment` does."""
    limit = pixel_limit(cameras.width, cameras.height)
    errors = pixel_errors(pairs, cameras)
    medians = tuple(
        float(np.quantile(part, 0.5, method="lower")) if len(part) else math.nan
        for part in pairs.split(errors, len(cameras))
    )
    count = max(1, len(errors))
    in_front, near = float(np.isfinite(errors).sum()) / count, float((errors <= 1).sum()) / count
    fits = [middle < limit for middle in medians if not math.isnan(middle)]
    return Alignment(medians, in_front, near, limit, bool(fits) and all(fits) and in_front > 0.5)
