"""Estimate cameras from the pixels of the rows, if no file gives cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsmerge.alignment.calibration import calibrate
from gsmerge.alignment.dropped_rows import find_dropped_grid
from gsmerge.alignment.layouts import ESTIMATED, exact_layouts, subsample
from gsmerge.alignment.row_grid import find_grid
from gsmerge.alignment.score import find_correspondences, is_clearly_nearer
from gsmerge.io.cameras.camera_file import W2C_OPENCV, CameraFile, StoredView, make_camera_file
from gsmerge.io.photo_files import Size
from gsmerge.types import Cameras, Gaussians

_GRID_GAUSSIANS = 300  # Gaussians per view that cameras are estimated from


def estimate_cameras(
    path: Path, gaussians: Gaussians, valid: np.ndarray, names: Sequence[str], *sizes: Size
) -> CameraFile | None:
    """Estimate cameras that show each row of a full or trimmed grid in its own pixel.

    ``names`` are the names of the views. All views have one of the ``sizes`` (width, height) in pixels. ``valid [n]``
    is bool, and ``path`` is for messages. None if no order of the rows fits at least twice as well as all other orders.
    """
    layouts = [layout for size in dict.fromkeys(sizes) for layout in exact_layouts(len(gaussians), len(names), *size)]
    possible = [layout for layout in layouts if layout.per_pixel == 1 and len(layout.views) == len(names)]
    fits = []
    for layout in possible:
        pairs = find_correspondences(gaussians.means, valid, subsample(layout, _GRID_GAUSSIANS))
        fit = calibrate(pairs, layout.width, layout.height, len(names))
        fits += [] if fit is None else [fit]
    fits.sort(key=lambda fit: fit.worst_px)
    if not fits or (len(fits) > 1 and not is_clearly_nearer(fits[0].worst_px, fits[1].worst_px)):
        return None
    return _make_cameras(path, names, fits[0].cameras)


def estimate_from_rows(path: Path, gaussians: Gaussians, valid: np.ndarray) -> CameraFile | None:
    """Estimate the cameras of rows that are the pixels of a grid of unknown size; None for other rows.

    The grid may lack some pixels. ``valid [n]`` is bool, and ``path`` is for messages.
    """
    grid = find_grid(gaussians, valid) or find_dropped_grid(gaussians.means, valid)
    if grid is None:
        return None
    layout, calibration = grid
    names = [f"view {view}" for view in range(len(calibration.cameras))]
    cameras = _make_cameras(path, names, calibration.cameras)
    if layout.kind == "pruned":
        cameras = replace(cameras, pixel_ids=layout.pixel_ids(len(gaussians)))
    return cameras


def _make_cameras(path: Path, names: Sequence[str], cameras: Cameras) -> CameraFile:
    """Make the camera file of estimated cameras."""
    posed = zip(names, cameras.viewmats[:, :3], cameras.Ks, strict=True)
    views = [StoredView(name, pose, K, (cameras.width, cameras.height)) for name, pose, K in posed]
    return make_camera_file(path, ESTIMATED, W2C_OPENCV, views)
