"""Estimate cameras from the pixels of the rows, if no file gives cameras."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from gsmerge.geometry.transforms import median
from gsmerge.io.cameras.camera_file import W2C_OPENCV, CameraFile, StoredView, make_camera_file
from gsmerge.reading.alignment.dropped_rows import find_dropped_grid
from gsmerge.reading.alignment.layouts import ESTIMATED


def estimate_cameras(path: Path, means: np.ndarray, valid: np.ndarray) -> CameraFile | None:
    """Estimate the cameras of rows ``means [n,3]`` that are the pixels of a grid; None for other rows.

    The rows are sorted by view, line and column, or by line, column and view. In both orders some pixels may have no
    row. ``valid [n]`` bool marks the finite rows, and ``path`` is for messages.
    """
    rows, step = np.arange(len(means)), _find_pixel_step(means)
    orders = (rows, rows.reshape(-1, step).T.reshape(-1)) if step > 1 and len(rows) % step == 0 else (rows,)
    # a row that is not finite may have a pixel, and is then interpolated, or may have no pixel; both are tried
    interpolated = np.stack([np.interp(rows, rows[valid], values) for values in means[valid].T], 1).astype(np.float32)
    point_sets = [(means, valid)] if valid.all() else [(means, valid), (interpolated, np.ones_like(valid))]
    for order, (points, used) in product(orders, point_sets):
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
    """Find the step in rows from a pixel to the next pixel of the same view.

    At this distance in rows, pairs of points ``means [n,3]`` are nearest to each other. The step is the number of views
    if rows are sorted by line, column and view. For other rows, and for few rows, the step is 1.
    """
    most_views = 64  # largest step that is tried
    min_pixels = 256  # fewest pixels of a view
    longest = min(most_views, len(means) // min_pixels)
    num_samples = 2000  # pairs of rows whose distance is measured for each step
    starts = np.linspace(0, max(0, len(means) - longest - 1), num_samples).astype(int)
    distances = [np.abs(means[starts + step] - means[starts]).sum(1) for step in range(1, longest + 1)]
    return 1 + int(np.argmin([median(values[np.isfinite(values)]) for values in distances])) if distances else 1
