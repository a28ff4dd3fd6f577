"""Cameras from the Gaussians themselves, where a grid of pixels is known and nothing else."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from gsmerge.io.alignment.layouts import Layout, exact_layouts, subsample
from gsmerge.io.alignment.score import find_correspondences, pixel_limit, split_blocks
from gsmerge.io.cameras.camera_file import W2C_OPENCV, CameraFile, View, make_camera_file, make_pinhole
from gsmerge.types import Gaussians

SOURCE = "estimated from the grid"
_SAMPLES = 300  # Gaussians per view
_MARGIN = 2.0  # by which the best order of the rows must beat the next one
_ROUNDS = 2  # each time without the Gaussians that lie far from their pixels
_NO_DISTORTION = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
_ONE_FOCAL = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO


def estimate_cameras(
    path: Path, gaussians: Gaussians, valid: np.ndarray, names: Sequence[str], width: int, height: int
) -> CameraFile | None:
    """Poses and one focal length under which every row of a full or trimmed grid projects into its own pixel.

    ``names`` are those of the views, all ``width`` x ``height`` pixels; ``valid [n]`` bool; ``path`` is for messages.
    None if no order of the rows fits at least twice as well as all others.
    """
    layouts = exact_layouts(len(gaussians), len(names), width, height)
    possible = [layout for layout in layouts if layout.per_pixel == 1 and len(layout.views) == len(names)]
    fits = [_calibrate(gaussians.means, valid, subsample(layout, _SAMPLES)) for layout in possible]
    fits.sort(key=lambda fit: fit[0])
    limit = pixel_limit(width, height)
    if not fits or fits[0][0] > limit or (len(fits) > 1 and fits[1][0] < _MARGIN * fits[0][0]):
        return None
    _, focal, poses = fits[0]
    K = make_pinhole(focal, focal, width / 2, height / 2)
    views = [View(name, pose, K, (width, height)) for name, pose in zip(names, poses, strict=True)]
    return make_camera_file(path, SOURCE, W2C_OPENCV, views)


def _calibrate(means: np.ndarray, valid: np.ndarray, layout: Layout) -> tuple[float, float, list[np.ndarray]]:
    """(largest median distance in pixels, focal length, poses) of one order of the rows; inf without one."""
    pairs = find_correspondences(means, valid, layout)
    middle = np.median(pairs.points, 0)
    unit = float(np.median(np.abs(pairs.points - middle))) or 1.0
    points = split_blocks((pairs.points - middle) / unit, pairs, len(layout.views))
    pixels = split_blocks(pairs.pixels, pairs, len(layout.views))
    focal = 1.2 * max(layout.width, layout.height)
    K = make_pinhole(focal, focal, layout.width / 2, layout.height / 2)
    kept = [np.ones(len(p), bool) for p in points]
    try:
        for _ in range(_ROUNDS):
            near = [p[k].astype(np.float32) for p, k in zip(points, kept, strict=True)]
            where = [p[k].astype(np.float32) for p, k in zip(pixels, kept, strict=True)]
            _, K, _, rotations, shifts = cv2.calibrateCamera(
                near, where, (layout.width, layout.height), K, np.zeros(5), flags=_ONE_FOCAL | _NO_DISTORTION
            )
            errors = [
                np.linalg.norm(cv2.projectPoints(p, r, t, K, None)[0][:, 0] - q, axis=1)
                for p, q, r, t in zip(points, pixels, rotations, shifts, strict=True)
            ]
            kept = [e <= max(1.0, 3 * float(np.median(e))) for e in errors]
    except cv2.error:
        return math.inf, 0.0, []
    poses = []
    for vector, shift in zip(rotations, shifts, strict=True):
        R = cv2.Rodrigues(vector)[0]
        poses.append(np.concatenate([R, unit * shift.reshape(3, 1) - R @ middle[:, None]], 1))
    worst = max(float(np.median(e)) for e in errors)
    return (worst if np.isfinite(worst) else math.inf), float(K[0, 0]), poses
