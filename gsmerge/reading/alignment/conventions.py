"""Read poses in another convention, and move inexact cameras.

If a model predicts poses, its Gaussians lie a little beside the pixels of their cameras. The pixels of a view and their
Gaussians determine the pose of the view, and its camera is moved to this pose. If photos agree better with the poses as
read, the Gaussians are wrong, and the result is marked as ``confirmed``. If photos of different views then disagree,
``gsmerge/prepare/move_poses.py`` moves the views later.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass, replace
from gsmerge.io.cameras.camera_file import (
    CONVENTIONS,
    Convention,
    describe_moves,
    from_viewmats,
    list_moves,
    to_viewmats,
)
from gsmerge.io.photo_files import NO_IMAGES
from gsmerge.method.geometry.transforms import camera_depths, is_inside, project_points, robust_weights
from gsmerge.method.kernels.matrices import invert, matmul, transform
from gsmerge.reading.alignment.frames import solve_pose
from gsmerge.reading.alignment.score import (
    Correspondences,
    check_pairs,
    is_as_near,
    max_correctable_px,
    photo_colors,
    pixel_errors,
)
from gsmerge.types import Cameras


@dataclass(frozen=True, eq=False)
class PosesInConvention:
    """The poses of a file, read in one convention."""

    convention: Convention
    viewmats: np.ndarray  # ``[c,4,4]`` float64, world to camera

    @property
    def description(self) -> str:
        """Description of the convention in words."""
        return describe_convention(self.convention)


def describe_convention(convention: Convention) -> str:
    """Describe a pose convention in words."""
    return f"{convention[0]} matrices with {convention[1]} axes"


def other_conventions(viewmats: np.ndarray, convention: Convention) -> list[PosesInConvention]:
    """List the poses of a file as read in each convention other than ``convention``.

    ``viewmats [c,4,4]`` are the poses of the file in ``convention``. Poses that are equal in two conventions are listed
    once.
    """
    stored = from_viewmats(viewmats, convention)
    all_poses = [PosesInConvention(convention, viewmats)]
    tolerance = 1e-6  # tolerance for equal poses, relative to the largest number in them
    for other in CONVENTIONS:
        converted = to_viewmats(stored, other)
        stacks = [poses.viewmats for poses in all_poses]
        if not any(np.allclose(converted, stack, atol=tolerance * (1 + np.abs(stack).max())) for stack in stacks):
            all_poses.append(PosesInConvention(other, converted))
    return all_poses[1:]


@dataclass(frozen=True)
class MovedCameras:
    """Cameras moved to fit their Gaussians, and how far each was moved."""

    cameras: Cameras
    worst_px: float  # largest median distance of a view's Gaussians from their pixels, before the move
    moves: list[dict[str, Any]]  # move of every view, see list_moves; empty if only the principal points were wrong
    confirmed: bool = False  # True if photos confirm the cameras as read, so the Gaussians have to be moved instead

    @property
    def note(self) -> str:
        """Note for the user on how far cameras were moved, one sentence."""
        if not self.moves:
            x, y = (self.cameras.Ks[:, :2, 2] - (self.cameras.width / 2, self.cameras.height / 2)).mean(0)
            return f"principal points lie ({x:.1f}, {y:.1f}) px from the middle, as the Gaussians' pixels show"
        if self.confirmed:
            text = (
                f"the Gaussians are off their pixels by a median of up to {self.worst_px:.1f} px: the Gaussians of each"
                " view were moved to its camera, since the photos agree better from there"
            )
        else:
            text = (
                f"the cameras are off by a median of up to {self.worst_px:.1f} px: each was moved to where its"
                " Gaussians lie in their pixels"
            )
        return f"{text}, {describe_moves(self.moves)}"


def move_cameras(
    pairs: Correspondences, cameras: Cameras, names: tuple[str, ...], source: str = "Ks", images: np.ndarray = NO_IMAGES
) -> MovedCameras | None:
    """Move cameras so that sampled Gaussians project into their pixels; None if a camera is too far from its pixels.

    If changed intrinsics fit as well as moved poses, the intrinsics are changed instead. Only principal points in the
    middle of the image may change, because these were probably just assumed. If other intrinsics would change, a
    SceneError that names ``source`` is raised. ``names`` are the names of the views. ``images [c,h,w,3]`` are photos,
    which may confirm the poses as read; they may be empty.
    """
    before = check_pairs(pairs, cameras)
    if not before.worst_px <= max_correctable_px(cameras.width, cameras.height):
        return None
    # each camera that is near_px or more off is moved to its own Gaussians
    viewmats = cameras.viewmats.astype(np.float64)
    errors = pixel_errors(pairs, cameras)
    near_px = 0.5  # cameras with smaller errors are not moved
    for view in np.unique(pairs.views):
        if np.median(errors[pairs.views == view]) > near_px:
            pose = solve_pose(pairs, int(view), cameras.Ks[view])
            if pose is None:
                return None
            viewmats[view] = pose
    moved = replace(cameras, viewmats=viewmats)
    after = check_pairs(pairs, moved)
    if not after.ok:
        return None
    # perhaps the poses are right, and the intrinsics wrong
    refitted = _fit_intrinsics(pairs, cameras, after.worst_px)
    if refitted is not None:
        # only principal points in the middle of the image were just assumed
        factors = refitted.Ks[0, (0, 1), (0, 1)] / cameras.Ks[0, (0, 1), (0, 1)]
        same_focal = 0.01  # largest relative difference of focal lengths that count as equal
        middle = cameras.width / 2, cameras.height / 2
        if (cameras.Ks[:, :2, 2] == middle).all() and (np.abs(factors - 1) <= same_focal).all():
            return MovedCameras(refitted, before.worst_px, [])
        x, y = (refitted.Ks[:, :2, 2] - cameras.Ks[:, :2, 2]).mean(0)
        raise SceneError(
            source,
            f"expected intrinsics that fit the Gaussians, found ones that put them {before.worst_px:.1f} px off their"
            " pixels in the same way in every view",
            f"multiply fx by {factors[0]:.4g} and fy by {factors[1]:.4g}, and add {x:.2f} to cx and {y:.2f} to cy"
            f" (pixels of {cameras.width} x {cameras.height})",
        )
    # Photos confirm the poses as read if photos of the same Gaussians agree better with these. The Gaussians lie where
    # the moved cameras show them. To compare both, the Gaussians of each view are moved back with its camera
    confirmed = False
    if len(images):
        motions = matmul(invert(cameras.viewmats), viewmats)[pairs.views]
        points = transform(motions[:, :3, :3], pairs.points) + motions[:, :3, 3]
        better_share = 0.96  # the poses are better if they reduce the disagreement between photos to this share
        limit = better_share * _measure_disagreement(pairs.points, pairs, images, moved)
        confirmed = _measure_disagreement(points, pairs, images, cameras) < limit
    depth = float(np.median(camera_depths(pairs.points, viewmats[pairs.views])))
    return MovedCameras(moved, before.worst_px, list_moves(names, cameras.viewmats, viewmats, depth), confirmed)


def _measure_disagreement(points: np.ndarray, pairs: Correspondences, images: np.ndarray, cameras: Cameras) -> float:
    """Measure the median difference in colour between two photos of the same point; inf if no point is in two photos.

    The first colour of a point is the colour of its pixel in ``pairs``. The other colours of the point are at the
    pixels of other views to which its position in ``points [t,3]`` projects.
    """
    x, y = pairs.pixels.astype(np.int64).T
    own_colors = photo_colors(images, pairs.views, y, x)
    errors = []
    for view in range(len(cameras)):
        with np.errstate(all="ignore"):
            xy, depth = project_points(points, cameras.viewmats[view], cameras.Ks[view])
        inside = (depth > 0) & is_inside(xy, cameras) & (pairs.views != view)
        column, row = xy[inside].astype(np.int64).T
        errors.append(np.abs(photo_colors(images, np.full(len(row), view), row, column) - own_colors[inside]).mean(1))
    values = np.concatenate(errors)
    return float(np.median(values)) if len(values) else np.inf


def _fit_intrinsics(pairs: Correspondences, cameras: Cameras, moved_px: float) -> Cameras | None:
    """Scale and shift the intrinsics of all views by the same factors and shifts; None if moved poses fit better.

    ``moved_px`` is the largest median error of a view with moved poses, in pixels.
    """
    if len(np.unique(pairs.views)) < 2:  # in a single view a shift of the picture looks like a rotation
        return None
    with np.errstate(all="ignore"):
        xy, depth = project_points(pairs.points[:, None], cameras.viewmats[pairs.views], cameras.Ks[pairs.views])
    in_front = (depth[:, 0] > 0) & np.isfinite(xy[:, 0]).all(1)
    projected = xy[in_front, 0]
    pixels = pairs.pixels[in_front]
    # x and y have separate fits of lines, because a point may fit in x but not in y
    factors = np.empty(2)
    shifts = np.empty(2)
    line_rounds = 4  # number of rounds of reweighted least squares
    for axis in range(2):
        x, y = (np.ascontiguousarray(values[:, axis]) for values in (projected, pixels))
        weights = np.ones(len(x))
        with np.errstate(all="ignore"):
            for _ in range(line_rounds):
                mean_x, mean_y = ((weights * values).sum() / weights.sum() for values in (x, y))
                dx = x - mean_x
                dy = y - mean_y
                factors[axis] = (weights * dx * dy).sum() / (weights * dx**2).sum()
                shifts[axis] = mean_y - factors[axis] * mean_x
                weights = robust_weights(np.abs(y - factors[axis] * x - shifts[axis]), 3, 1e-9)
    Ks = cameras.Ks * np.array([*factors, 1])[:, None]
    Ks[:, :2, 2] += shifts
    refitted = replace(cameras, Ks=Ks)
    check = check_pairs(pairs, refitted)
    return refitted if check.ok and is_as_near(check.worst_px, moved_px) else None
