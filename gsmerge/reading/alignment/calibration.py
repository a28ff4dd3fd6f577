"""Calibrate cameras from points and their pixels: poses, and intrinsics for each view or common to all.

Intrinsics are as simple as the points allow. Of several models of cameras, the model with the smallest Bayesian
information criterion is chosen (Schwarz 1978).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress

import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.io.cameras.camera_file import make_pinhole
from gsmerge.io.photo_files import Size
from gsmerge.method.kernels.elementary import log
from gsmerge.method.kernels.matrices import matmul
from gsmerge.reading.alignment.resection import (
    ALL_INTRINSICS,
    ONE_FOCAL,
    TWO_FOCALS,
    focal_uncertainty,
    projection_errors,
    projective_error,
    refine_poses,
    start_pose,
)
from gsmerge.reading.alignment.score import Correspondences, is_as_near, pixel_limit
from gsmerge.types import Cameras

_FREE_INTRINSICS = (ONE_FOCAL, TWO_FOCALS, ALL_INTRINSICS)
# A point is far from its pixel if its distance is above _FAR times the median distance, and above _FAR_PX pixels
_FAR = 3.0
_FAR_PX = 1.0


@dataclass(frozen=True, eq=False)
class _Model:
    """Cameras of v views, solved for with ``free`` free intrinsics, and the errors of these cameras."""

    Ks: np.ndarray  # [v,3,3]
    poses: np.ndarray  # [v,4,4] world to camera
    free: int  # number of free intrinsics, over all views
    errors: tuple[np.ndarray, ...]  # of each view: the distances of its points from their pixels

    @property
    def worst_px(self) -> float:
        """Largest median distance of a view's points from their pixels, in pixels."""
        worst = max(float(np.median(errors)) for errors in self.errors)
        return worst if math.isfinite(worst) else math.inf

    def criterion(self, far: float) -> float:
        """Compute the Bayesian information criterion, with distances clipped at ``far`` pixels."""
        with np.errstate(invalid="ignore"):
            smallest_px = 1e-3  # smaller distances count as smallest_px, since means have only 24 bits
            errors = np.nan_to_num(np.concatenate(self.errors), nan=far).clip(smallest_px, far)
        count = 2.0 * len(errors)
        return count * float(log((errors * errors).mean())) + self.free * float(log(count))


def calibrate(pairs: Correspondences, width: int, height: int) -> Cameras | None:
    """Calibrate the cameras of views of ``width`` x ``height`` pixels from ``pairs`` of Gaussians and pixels.

    A view without pairs gets the camera of the view before it. Returns None if the points do not determine the cameras,
    or if they lie farther from their pixels than :func:`pixel_limit`.
    """
    if not len(pairs.points):
        return None
    view_ids = np.unique(pairs.views)
    views = [pairs.select(pairs.views == view) for view in view_ids]
    middle = np.median(pairs.points, 0)
    unit = float(np.median(np.abs(pairs.points - middle))) or 1.0
    points = [(view.points - middle) / unit for view in views]
    pixels = [view.pixels for view in views]
    limit_px = pixel_limit(width, height)
    projective_px = max(map(projective_error, points, pixels), default=math.inf)
    # the simplest intrinsics that explain the pixels
    models: list[_Model] = []
    if projective_px <= limit_px:
        with suppress(np.linalg.LinAlgError):  # raised at the first model that the points do not determine
            models.extend(_solve_models(points, pixels, (width, height), projective_px))
    far_px = max(_FAR_PX, _FAR * min((model.worst_px for model in models), default=math.inf))
    model = min(models, key=lambda model: model.criterion(far_px), default=None)
    if model is None or model.worst_px > limit_px:
        return None
    # relative uncertainty of the focal length, which is large if points nearly lie in a plane in front of the camera
    max_uncertainty = 0.05
    if focal_uncertainty(points, pixels, model.Ks, model.poses) > max_uncertainty:
        return None
    viewmats = model.poses.copy()
    viewmats[:, :3, 3] = unit * viewmats[:, :3, 3] - matmul(viewmats[:, :3, :3], middle)
    all_views = np.arange(int(view_ids[-1]) + 1)
    solved = np.maximum(np.searchsorted(view_ids, all_views, side="right") - 1, 0)  # index of the solved camera
    return Cameras(viewmats[solved], model.Ks[solved], width, height)


def _solve_models(
    points: Sequence[np.ndarray], pixels: Sequence[np.ndarray], size: Size, projective_px: float
) -> Iterator[_Model]:
    """Yield models from simple to complex: with intrinsics common to all views, then with intrinsics for each view.

    ``points`` and ``pixels`` are ``[n,3]`` and ``[n,2]`` for each view. Models with intrinsics for each view are left
    out if the error of common intrinsics is as small as ``projective_px``, the error of the best projective cameras.
    """
    one_focal_models = []
    first_focals = (1.2, 4.8)  # focal lengths, in longer sides of the picture, at which the search begins
    for focal_in_sides in first_focals:
        focal = focal_in_sides * max(size)
        K = make_pinhole(focal, focal, size[0] / 2, size[1] / 2)
        starts = [start_pose(p, q, K) for p, q in zip(points, pixels, strict=True)]
        poses = np.stack([pose for pose in starts if pose is not None] or [np.eye(4)])
        if len(poses) < len(starts):  # the points of a view determine no pose
            return
        start = _Model(np.tile(K, (len(starts), 1, 1)), poses, 0, ())
        for free in _FREE_INTRINSICS:
            model = _fit_model(points, pixels, start, free)
            if free == ONE_FOCAL:
                one_focal_models.append(model)
            else:
                start = model
            yield model
        if is_as_near(model.worst_px, projective_px):  # more intrinsics cannot be nearer
            return
    model = min(one_focal_models, key=lambda model: model.worst_px)
    for free in _FREE_INTRINSICS if len(points) > 1 else ():
        view_starts = (replace(model, Ks=model.Ks[v : v + 1], poses=model.poses[v : v + 1]) for v in range(len(points)))
        views = [_fit_model([p], [q], start, free) for p, q, start in zip(points, pixels, view_starts, strict=True)]
        Ks = np.concatenate([view.Ks for view in views])
        poses = np.concatenate([view.poses for view in views])
        model = _Model(Ks, poses, free * len(views), tuple(view.errors[0] for view in views))
        yield model


def _fit_model(points: Sequence[np.ndarray], pixels: Sequence[np.ndarray], start: _Model, free: int) -> _Model:
    """Solve for the poses, and for ``free`` intrinsics common to all views, from the cameras of ``start``.

    Raises numpy.linalg.LinAlgError if the points do not determine poses and intrinsics.
    """
    K = start.Ks[0]
    poses = start.poses
    near_points = points
    near_pixels = pixels
    rounds = 2  # rounds of solving; the second leaves out points that are far from their pixels after the first
    for _ in range(rounds):
        K, poses = refine_poses(near_points, near_pixels, K, poses, free=free)
        errors = [projection_errors(p, q, K, pose) for p, q, pose in zip(points, pixels, poses, strict=True)]
        is_near = [e <= max(_FAR_PX, _FAR * float(np.median(e))) for e in errors]  # one mask for each view
        near_points = [view_points[mask] for view_points, mask in zip(points, is_near, strict=True)]
        near_pixels = [view_pixels[mask] for view_pixels, mask in zip(pixels, is_near, strict=True)]
    return _Model(np.tile(K, (len(poses), 1, 1)), poses, free, tuple(errors))
