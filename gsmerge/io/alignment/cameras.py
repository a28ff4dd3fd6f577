"""Read poses in another convention, estimate missing ones, and move inexact cameras.

Models that predict poses write Gaussians and cameras that differ a little. A pose for each view follows from its
pixels and their Gaussians alone; the photos show much later which of the two was wrong
(``gsmerge/stages/align_views.py``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry import camera_depths, project_points, sh0_to_rgb
from gsmerge.io.alignment.layouts import Layout, exact_layouts, subsample
from gsmerge.io.alignment.resection import projection_errors, refine_poses, start_pose
from gsmerge.io.alignment.score import (
    IDENTITY,
    MARGIN,
    AlignmentInput,
    Correspondences,
    Similarity,
    check_pairs,
    find_correspondences,
    pixel_errors,
    pixel_limit,
    solve_pose,
)
from gsmerge.io.cameras.camera_file import (
    CONVENTIONS,
    W2C_OPENCV,
    CameraFile,
    Convention,
    View,
    describe_moves,
    from_viewmats,
    list_moves,
    make_camera_file,
    make_pinhole,
    to_viewmats,
    with_convention,
)
from gsmerge.kernels.matrices import matmul
from gsmerge.types import Cameras, Gaussians

_SEEN_AS_MUCH = 0.98  # of the score of what the cameras see: no difference
_SAME = 1e-6  # of the cameras' distances: no difference
_SEEN_SAMPLES = 20_000  # Gaussians that are projected to see whether cameras see them
_MIN_SEEN = 0.5  # share of them that some camera sees
_MAX_COLOR_RATIO = 0.85  # of their colours' distance from the photos, over that from random pixels
_SAME_COLORS = 0.01  # mean distance of the colours from random pixels below which photos say nothing

ESTIMATED = "estimated from the grid"  # source of estimated cameras
_GRID_SAMPLES = 300  # Gaussians per view that cameras are estimated from
_CALIBRATIONS = 2  # each time without the Gaussians that lie far from their pixels

MAX_PX, MAX_SHARE = 12.0, 0.05  # pixels, and share of a small image's side, that cameras may be off
NEAR_PX = 0.5  # cameras that are nearer stay where they are
AS_GOOD, AS_GOOD_PX = 1.3, 0.25  # times and pixels more than moved cameras leave, up to which other intrinsics fit
_LINE_ROUNDS = 4  # of reweighted least squares


@dataclass(frozen=True)
class Poses:
    """Poses in one convention: ``viewmats [c,4,4]`` float64, world to camera."""

    convention: Convention
    viewmats: np.ndarray

    @property
    def description(self) -> str:
        """Words for the convention."""
        return f"{self.convention[0]} matrices with {self.convention[1]} axes"

    def describe(self, usual: Convention) -> str:
        """Write that these poses fit, in place of those in the format's ``usual`` convention."""
        return f"the poses fit when read as {self.description}, where this format has {usual[0]} with {usual[1]} axes"


def other_conventions(viewmats: np.ndarray, convention: Convention) -> list[Poses]:
    """Read poses ``viewmats [c,4,4]`` in all other conventions, without repetitions."""
    stored, readings = from_viewmats(viewmats, convention), [Poses(convention, viewmats)]
    for other in CONVENTIONS:
        read = to_viewmats(stored, other)
        known = [poses.viewmats for poses in readings]
        if not any(np.allclose(read, one, atol=_SAME * (1 + np.abs(one).max())) for one in known):
            readings.append(Poses(other, read))
    return readings[1:]


@dataclass(frozen=True)
class CameraCheck:
    """Measures of how well cameras see some Gaussians."""

    share_seen: float  # share of the Gaussians inside at least one picture
    # distance of their colours from the photos where they are seen, over the distance from the same pixels shuffled;
    # NaN without photos, or where the colours hardly vary
    color_ratio: float
    ok: bool  # whether these are likely the cameras of these Gaussians

    @property
    def score(self) -> float:
        """0 to 1, to rank cameras by: the share that is seen, reduced where colours fit little better than random."""
        return self.share_seen * (1.0 if np.isnan(self.color_ratio) else max(0.0, 1 - self.color_ratio))

    @property
    def description(self) -> str:
        """The figures in one sentence."""
        seen = f"the cameras see {100 * self.share_seen:.0f} % of the Gaussians"
        if np.isnan(self.color_ratio):
            return seen
        return f"{seen}, whose colours are {self.color_ratio:.2f} times as far from the photos as any others"


def check_cameras(gaussians: Gaussians, valid: np.ndarray, cameras: Cameras, images: np.ndarray | None) -> CameraCheck:
    """Project some valid Gaussians into all views, and compare their colours with ``images [c,h,w,3]``, if any."""
    rows = np.flatnonzero(valid)
    rows = rows[:: max(1, len(rows) // _SEEN_SAMPLES)]
    points = gaussians.means[rows].astype(np.float64)
    colors = sh0_to_rgb(gaussians.sh0[rows, 0]).clip(0, 1)
    visible, errors, others = np.zeros(len(rows), bool), [], []
    rng = np.random.default_rng(0)
    for view in range(len(cameras)):
        with np.errstate(all="ignore"):
            xy, depth = project_points(points, cameras.viewmats[view], cameras.Ks[view])
            xy = np.floor(xy)
        inside = (depth > 0) & (xy >= 0).all(1) & (xy < (cameras.width, cameras.height)).all(1)
        visible |= inside
        if images is not None and inside.any():
            x, y = xy[inside].astype(np.int64).T
            photo = images[view, y, x]
            errors.append(np.abs(colors[inside] - photo).mean(1))
            others.append(np.abs(colors[inside] - rng.permutation(photo)).mean(1))
    share, ratio = float(visible.mean()), np.nan
    if errors and (other := float(np.concatenate(others).mean())) > _SAME_COLORS:
        ratio = float(np.concatenate(errors).mean()) / other
    return CameraCheck(share, ratio, share >= _MIN_SEEN and not ratio > _MAX_COLOR_RATIO)


def choose_poses(
    gaussians: Gaussians, valid: np.ndarray, cameras: Cameras, images: np.ndarray | None, convention: Convention
) -> tuple[Poses | None, CameraCheck, str | None]:
    """Choose the convention of the poses that sees most unaligned Gaussians, with colours nearest to the photos.

    Arguments are as for :func:`check_cameras`, with the cameras under the usual convention. Returns the poses if
    they are clearly better than the usual ones and all others, otherwise None; the check of the chosen ones; and a
    note where others see as much as the usual ones.
    """
    usual = check_cameras(gaussians, valid, cameras, images)
    others = [
        (poses, check_cameras(gaussians, valid, replace(cameras, viewmats=poses.viewmats), images))
        for poses in other_conventions(cameras.viewmats, convention)
    ]
    ranked = sorted(others, key=lambda one: -one[1].score)
    if not ranked or not ranked[0][1].ok:
        return None, usual, None
    poses, best = ranked[0]
    scores = [check.score for check in (usual, *(check for _, check in ranked[1:2])) if check.ok]
    if best.score >= MARGIN * max(scores, default=0.0):
        return poses, best, None
    as_good = usual.ok and best.score >= _SEEN_AS_MUCH * usual.score
    note = f"the poses fit as well when read as {poses.description}; they are read as the format has them"
    return None, usual, note if as_good else None


def choose_cameras(
    inputs: AlignmentInput, camera_file: CameraFile, frames: Sequence[Similarity], why: SceneError
) -> tuple[Cameras, CameraFile, list[str]]:
    """Choose cameras that see the Gaussians: as given, in another frame, or in another convention; with notes.

    SceneError if none of these does, with the reason ``why`` there are no pixels.
    """
    rows = inputs.gaussians, inputs.valid
    moved = [(frame, frame.move(inputs.cameras)) for frame in (IDENTITY, *frames)]
    if frames:
        stay, *checks = (check_cameras(*rows, cameras, inputs.images) for _, cameras in moved)
        best = max(checks, key=lambda check: check.score)
        if best.ok and best.score > stay.score:
            frame, cameras = moved[1 + checks.index(best)]
            return cameras, replace(camera_file, viewmats=cameras.viewmats), [f"the cameras are {frame.description}"]
    poses, check, note = choose_poses(*rows, inputs.cameras, inputs.images, camera_file.convention)
    if not check.ok:
        raise SceneError(why.path, f"{why.problem}; {check.description}", why.remedy)
    if poses is None:
        return inputs.cameras, camera_file, [note] if note else []
    cameras = replace(inputs.cameras, viewmats=poses.viewmats)
    note = f"{poses.describe(camera_file.convention)}: read so"
    return cameras, with_convention(camera_file, poses.convention), [note]


def estimate_cameras(
    path: Path, gaussians: Gaussians, valid: np.ndarray, names: Sequence[str], width: int, height: int
) -> CameraFile | None:
    """Estimate poses and one focal length under which rows of a full or trimmed grid project into their own pixels.

    ``names`` are those of the views, all ``width`` x ``height`` pixels; ``valid [n]`` bool; ``path`` is for
    messages. None if no order of the rows fits at least twice as well as all others.
    """
    layouts = exact_layouts(len(gaussians), len(names), width, height)
    possible = [layout for layout in layouts if layout.per_pixel == 1 and len(layout.views) == len(names)]
    fits = [_calibrate(gaussians.means, valid, subsample(layout, _GRID_SAMPLES)) for layout in possible]
    fits.sort(key=lambda fit: fit[0])
    limit = pixel_limit(width, height)
    if not fits or fits[0][0] > limit or (len(fits) > 1 and fits[1][0] < MARGIN * fits[0][0]):
        return None
    _, focal, poses = fits[0]
    K = make_pinhole(focal, focal, width / 2, height / 2)
    views = [View(name, pose, K, (width, height)) for name, pose in zip(names, poses, strict=True)]
    return make_camera_file(path, ESTIMATED, W2C_OPENCV, views)


def _calibrate(means: np.ndarray, valid: np.ndarray, layout: Layout) -> tuple[float, float, list[np.ndarray]]:
    """Solve for (largest median distance in pixels, focal length, poses) of one order of the rows; inf on failure."""
    pairs = find_correspondences(means, valid, layout)
    middle = np.median(pairs.points, 0)
    unit = float(np.median(np.abs(pairs.points - middle))) or 1.0
    points = pairs.split((pairs.points - middle) / unit, len(layout.views))
    pixels = pairs.split(pairs.pixels, len(layout.views))
    focal = 1.2 * max(layout.width, layout.height)
    K = make_pinhole(focal, focal, layout.width / 2, layout.height / 2)
    kept = [np.ones(len(p), bool) for p in points]
    starts = [start_pose(p, q, K) for p, q in zip(points, pixels, strict=True)]
    found = [pose for pose in starts if pose is not None]
    if len(found) < len(starts):
        return math.inf, 0.0, []
    poses = np.stack(found)
    for _ in range(_CALIBRATIONS):
        near, where = ([p[k] for p, k in zip(some, kept, strict=True)] for some in (points, pixels))
        try:
            K, poses = refine_poses(near, where, K, poses, focal=True)
        except np.linalg.LinAlgError:
            return math.inf, 0.0, []
        errors = [projection_errors(p, q, K, pose) for p, q, pose in zip(points, pixels, poses, strict=True)]
        kept = [e <= max(1.0, 3 * float(np.median(e))) for e in errors]
    poses[:, :3, 3] = unit * poses[:, :3, 3] - matmul(poses[:, :3, :3], middle)
    worst = max(float(np.median(e)) for e in errors)
    return (worst if np.isfinite(worst) else math.inf), float(K[0, 0]), list(poses[:, :3])


@dataclass(frozen=True)
class MovedCameras:
    """Cameras in their new places, and how far they were moved."""

    cameras: Cameras
    worst_px: float  # the largest median distance of a view's Gaussians from their pixels before
    moves: list[dict[str, Any]]  # of every view, see list_moves

    @property
    def note(self) -> str:
        """A sentence on the move."""
        return (
            f"the cameras are off by a median of up to {self.worst_px:.1f} px: each was moved to where its Gaussians"
            f" lie in their pixels, {describe_moves(self.moves)}"
        )


def max_pixels(width: int, height: int) -> float:
    """Return the median distance in pixels up to which cameras are moved; beyond it a scene is refused."""
    return max(pixel_limit(width, height), min(MAX_PX, MAX_SHARE * math.sqrt(width * height)))


def move_cameras(
    pairs: Correspondences, cameras: Cameras, names: tuple[str, ...], source: str = "Ks"
) -> MovedCameras | None:
    """Move cameras to where the Gaussians of a sample project into their pixels; None where some are too far off.

    SceneError, which names ``source``, where the intrinsics are wrong rather than the poses.
    """
    before = check_pairs(pairs, cameras)
    if not before.worst_px <= max_pixels(cameras.width, cameras.height):
        return None
    viewmats, errors = cameras.viewmats.astype(np.float64), pixel_errors(pairs, cameras)
    for view in np.unique(pairs.views):
        if np.median(errors[pairs.views == view]) > NEAR_PX:
            pose = solve_pose(pairs, int(view), cameras.Ks[view])
            if pose is None:
                return None
            viewmats[view] = pose
    moved = replace(cameras, viewmats=viewmats)
    after = check_pairs(pairs, moved)
    if not after.ok:
        return None
    _check_intrinsics(pairs, cameras, before.worst_px, after.worst_px, source)
    depth = float(np.median(camera_depths(pairs.points, viewmats[pairs.views])))
    return MovedCameras(moved, before.worst_px, list_moves(names, cameras.viewmats, viewmats, depth))


def fit_line(x: np.ndarray, y: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """Fit a line to points by weighted least squares; return its slope, and its height at 0."""
    total = weights.sum()
    left, right = (weights * x).sum() / total, (weights * y).sum() / total
    slope = float((weights * (x - left) * (y - right)).sum() / (weights * (x - left) ** 2).sum())
    return slope, float(right - slope * left)


def _check_intrinsics(pairs: Correspondences, cameras: Cameras, before_px: float, moved_px: float, source: str) -> None:
    """Raise a SceneError where one change of all Ks fits the Gaussians as well as moved poses."""
    if len(np.unique(pairs.views)) < 2:  # in one view a turn and a shift of the picture are one
        return
    factors, shifts = np.ones(2), np.zeros(2)
    with np.errstate(all="ignore"):
        places, depth = project_points(pairs.points[:, None], cameras.viewmats[pairs.views], cameras.Ks[pairs.views])
    good = (depth[:, 0] > 0) & np.isfinite(places[:, 0]).all(1)
    for axis in range(2):
        before, wanted = places[good, 0, axis], pairs.pixels[good, axis]
        weights = np.ones(len(before))
        for _ in range(_LINE_ROUNDS):
            factors[axis], shifts[axis] = fit_line(before, wanted, weights**2)
            error = np.abs(factors[axis] * before + shifts[axis] - wanted)
            weights = 1 / np.sqrt(1 + (error / (3 * np.median(error) + 1e-9)) ** 2)
    Ks = cameras.Ks * np.array([*factors, 1])[:, None]
    Ks[:, :2, 2] += shifts
    other = check_pairs(pairs, replace(cameras, Ks=Ks))
    if not (other.ok and other.worst_px <= max(AS_GOOD * moved_px, moved_px + AS_GOOD_PX)):
        return
    x, y = (Ks[:, :2, 2] - cameras.Ks[:, :2, 2]).mean(0)
    raise SceneError(
        source,
        f"expected intrinsics that fit the Gaussians, found others, under which they lie {before_px:.1f} px off their"
        " pixels in every view alike",
        f"multiply fx by {factors[0]:.4g} and fy by {factors[1]:.4g}, and add {x:.2f} to cx and {y:.2f} to cy"
        f" (pixels of {cameras.width} x {cameras.height})",
    )
