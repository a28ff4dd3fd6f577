"""Estimate cameras from the pixels of the rows, if no file gives cameras."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from gsmerge.cameras.dropped_rows import find_dropped_grid
from gsmerge.cameras.layouts import ESTIMATED
from gsmerge.geometry.transforms import median
from gsmerge.io.cameras.camera_file import W2C_OPENCV, CameraFile, StoredView, make_camera_file


def estimate_cameras(path: Path, means: np.ndarray, valid: np.ndarray) -> CameraFile | None:
    """Estimate the cameras of rows ``means [n,3]`` that are the pixels of a grid; None for other rows.

    Rows are view by view, of which some pixels may have no row, or the views of a pixel follow each other. ``valid
    [n]`` is bool, and ``path`` is for messages.
    """
    rows, num_mixed = np.arange(len(means)), _find_pixel_step(means)
    mixed = [rows.reshape(-1, num_mixed).T.reshape(-1)] if num_mixed > 1 and len(rows) % num_mixed == 0 else []
    # a row that is no number may be a pixel like others, or there may be none for its pixel
    filled = np.stack([np.interp(rows, rows[valid], values) for values in means[valid].T], 1).astype(np.float32)
    possible = [(means, valid)] if valid.all() else [(means, valid), (filled, np.ones_like(valid))]
    for order, (points, used) in product((rows, *mixed), possible):
        grid = find_dropped_grid(points[order], used[order])
        if grid is not None:
            layout, calibration = grid
            pixel_ids = np.empty(len(rows), np.int64)
            pixel_ids[order] = np.where(valid[order], layout.pixel_ids(), -1)
            cameras = calibration.cameras
            views = [
                StoredView(f"view {view}", pose, K, (cameras.width, cameras.height))
                for view, (pose, K) in enumerate(zip(cameras.viewmats[:, :3], cameras.Ks, strict=True))
            ]
            return replace(make_camera_file(path, ESTIMATED, W2C_OPENCV, views), pixel_ids=pixel_ids)
    return None


def _find_pixel_step(means: np.ndarray) -> int:
    """Find the step in rows between neighbouring pixels, which is the number of views that follow each other.

    It is the step after which points ``means [n,3]`` are nearest; 1 for a few rows.
    """
    most_views = 64  # views that may follow each other at every pixel
    few_pixels = 256  # of a view, at least
    longest = min(most_views, len(means) // few_pixels)
    num_steps = 2000  # steps that are measured for each number of views
    starts = np.linspace(0, max(0, len(means) - longest - 1), num_steps).astype(int)
    lengths = [np.abs(means[starts + step] - means[starts]).sum(1) for step in range(1, longest + 1)]
    return 1 + int(np.argmin([median(steps[np.isfinite(steps)]) for steps in lengths])) if lengths else 1
