"""Read poses in another convention, estimate missing ones, and move inexact cameras.

Models that predict poses write Gaussians and cameras that differ a little. A pose for each view follows from its
pixels and their Gaussians alone; the photos show much later which of the two was wrong
(``gsmerge/facts/align_views.py``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.alignment.layouts import Layout, exact_layouts, subsample
from gsmerge.alignment.resection import projection_errors, refine_poses, start_pose
from gsmerge.alignment.score import (
    MARGIN,
    Correspondences,
    check_pairs,
    find_correspondences,
    pixel_errors,
    pixel_limit,
    solve_pose,
)
from gsmerge.errors import SceneError
from gsmerge.geometry import camera_depths, project_points
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
)
from gsmerge.kernels.matrices import matmul
from gsmerge.types import Cameras, Gaussians

_SAME = 1e-6  # of the cameras' distances: no difference

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


def estimate_cameras(
    path: Path, gaussians: Gaussians, valid: np.ndarray, names: Sequence[str], width: int, height: int
) -> CameraFile | None:
    """Estimate poses and one focal length under which rows of a full or trimmed grid project into their own pixels.

    ``names`` are those of the views, all ``width`` x ``height`` pixels; ``valid [n]`` bool; ``path`` is for
    messages. None if no order of the rows fits at least twice as well as all others.
    """
    layouts = exact_layouts(len(gaussians), len(names), width, height)
    possible = [layout for layout in layouts if layout.per_pixel == 1 and len(layout.views) == len(names)]
    fits = [calibrate(gaussians.means, valid, subsample(layout, _GRID_SAMPLES)) for layout in possible]
    fits.sort(key=lambda fit: fit[0])
    limit = pixel_limit(width, height)
    if not fits or fits[0][0] > limit or (len(fits) > 1 and fits[1][0] < MARGIN * fits[0][0]):
        return None
    _, focal, poses = fits[0]
    K = make_pinhole(focal, focal, width / 2, height / 2)
    views = [View(name, pose, K, (width, height)) for name, pose in zip(names, poses, strict=True)]
    return make_camera_file(path, ESTIMATED, W2C_OPENCV, views)


def calibrate(
    means: np.ndarray, valid: np.ndarray, layout: Layout, aspect: float = 1.0
) -> tuple[float, float, list[np.ndarray]]:
    """Solve for (largest median distance in pixels, focal length, poses) of one order of the rows; inf on failure.

    The vertical focal length is ``aspect`` times the horizontal one; the principal point is the middle.
    """
    pairs = find_correspondences(means, valid, layout)
    middle = np.median(pairs.points, 0)
    unit = float(np.median(np.abs(pairs.points - middle))) or 1.0
    points = pairs.split((pairs.points - middle) / unit, len(layout.views))
    pixels = pairs.split(pairs.pixels, len(layout.views))
    focal = 1.2 * max(layout.width, layout.height)
    K = make_pinhole(focal, aspect * focal, layout.width / 2, layout.height / 2)
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
