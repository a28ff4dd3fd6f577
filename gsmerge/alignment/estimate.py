"""Estimate cameras from the pixels of the rows, if no file gives cameras."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsmerge.alignment.calibration import Calibration, calibrate
from gsmerge.alignment.dropped_rows import find_dropped_grid
from gsmerge.alignment.layouts import ESTIMATED, Layout, exact_layouts, subsample, thinned_layouts
from gsmerge.alignment.row_grid import find_grid
from gsmerge.alignment.score import find_correspondences, is_as_near, is_clearly_nearer
from gsmerge.io.cameras.camera_file import W2C_OPENCV, CameraFile, StoredView, make_camera_file
from gsmerge.io.photo_files import Size
from gsmerge.kernels.elementary import log
from gsmerge.types import Cameras, Gaussians

_GRID_GAUSSIANS = 300  # Gaussians per view that cameras are estimated from


def estimate_cameras(
    path: Path, gaussians: Gaussians, valid: np.ndarray, names: Sequence[str], *sizes: Size
) -> CameraFile | None:
    """Estimate cameras that show each row of a full, trimmed or evenly thinned grid in its own pixel.

    ``names`` are the names of the views. All views have one of the ``sizes`` (width, height) in pixels. ``valid [n]``
    is bool, and ``path`` is for messages. None if no order of the rows fits at least twice as well as all other orders.
    """
    layouts = [layout for size in dict.fromkeys(sizes) for layout in exact_layouts(len(gaussians), len(names), *size)]
    possible = [layout for layout in layouts if layout.per_pixel == 1 and len(layout.views) == len(names)]
    fits = _calibrate(gaussians, valid, possible)
    if not any(layout.kind == "full" for _, layout in fits):
        thinned = _choose_thinned(gaussians, valid, len(names), sizes)
        if thinned is not None and not any(_oblongness(fit) <= _oblongness(thinned[0]) for fit, _ in fits):
            fit, layout = thinned
            return replace(_make_cameras(path, names, fit.cameras), pixel_ids=layout.pixel_ids(len(gaussians)))
    fits.sort(key=lambda fit: fit[0].worst_px)
    if not fits or (len(fits) > 1 and not is_clearly_nearer(fits[0][0].worst_px, fits[1][0].worst_px)):
        return None
    return _make_cameras(path, names, fits[0][0].cameras)


def _calibrate(gaussians: Gaussians, valid: np.ndarray, layouts: Iterable[Layout]) -> list[tuple[Calibration, Layout]]:
    """Calibrate the cameras of each layout; leave out layouts that fit no cameras."""
    fits = []
    for layout in layouts:
        pairs = find_correspondences(gaussians.means, valid, subsample(layout, _GRID_GAUSSIANS))
        fit = calibrate(pairs, layout.width, layout.height, len(set(layout.views)))
        fits += [] if fit is None else [(fit, layout)]
    return fits


def _choose_thinned(
    gaussians: Gaussians, valid: np.ndarray, views: int, sizes: Sequence[Size]
) -> tuple[Calibration, Layout] | None:
    """Choose the layout of rows from which every k-th pixel was dropped, or is left; None if none fits.

    The first pixel is often ambiguous by a few columns. Of the layouts that fit about as well as the best, the one with
    the principal point nearest to the middle is taken.
    """
    layouts = (layout for size in dict.fromkeys(sizes) for layout in thinned_layouts(len(gaussians), views, *size))
    fits = _calibrate(gaussians, valid, layouts)
    nearest = min((fit.worst_px for fit, _ in fits), default=0.0)
    near_fits = [(fit, layout) for fit, layout in fits if is_as_near(fit.worst_px, nearest)]
    return min(near_fits, key=lambda near_fit: _distance_from_middle(near_fit[0].cameras), default=None)


def _distance_from_middle(cameras: Cameras) -> float:
    """Return the mean distance of the principal points from the middle of the picture, pixels."""
    return float(np.linalg.norm(cameras.Ks[:, :2, 2] - (cameras.width / 2, cameras.height / 2), axis=1).mean())


def _oblongness(fit: Calibration) -> float:
    """Return how far the pixels of a fit are from squares: the natural logarithm of the ratio of their sides."""
    return float(np.median(np.abs(log(fit.cameras.Ks[:, 0, 0] / fit.cameras.Ks[:, 1, 1]))))


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
