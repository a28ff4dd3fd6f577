"""Read rows as pixels of the cameras that fit them if a few views have no camera, or one that does not fit."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from gsmerge.alignment.cameras import max_pixels
from gsmerge.alignment.grids import Grid
from gsmerge.alignment.judge import Candidate, Recovery, judge
from gsmerge.alignment.layouts import dropped_layout, plain_layout
from gsmerge.alignment.match import RowSource
from gsmerge.alignment.score import pixel_errors, pixel_limit, sample_layout, score_layout
from gsmerge.geometry import IDENTITY
from gsmerge.runtime.record import list_some

_MOST = 0.75  # least share of the views whose cameras fit; with fewer the cameras may be of another scene


def align_most_views(source: RowSource, grid: Grid) -> Recovery | None:
    """Take rows in order as the pixels of all views whose stored cameras fit; None if that is not most views.

    Rows of other views belong to no pixel, and cameras that do not fit have no view.
    """
    fits = _find_fits(source, grid)
    if fits is None or np.count_nonzero(fits.cameras >= 0) < _MOST * len(fits.cameras):
        return None
    fitting, area, views = np.flatnonzero(fits.cameras >= 0), math.prod(grid.size), len(fits.cameras)
    ids = np.full((views, area), -1, np.int64)
    ids[fitting] = fits.cameras[fitting, None] * area + np.arange(area)
    layout = dropped_layout(ids.reshape(-1), len(grid.cameras), *grid.size).without_empty_parts()
    layout = replace(layout, description=f"every pixel of {len(fitting)} of {views} views, view-major")
    grid = replace(grid, left_out=_describe(grid, fits, is_left_out=True))
    scored = score_layout(source.inputs(grid, photos=False), layout, IDENTITY)
    return judge([Candidate(grid, scored)], source.inputs, lambda candidate: candidate)


def describe_misfits(source: RowSource, grid: Grid) -> tuple[str, ...]:
    """Note cameras that do not fit the rows of their views if other cameras fit theirs."""
    fits = _find_fits(source, grid)
    return () if fits is None else _describe(grid, fits, is_left_out=False)


@dataclass(frozen=True, eq=False)
class _Fits:
    """Median distances, pixels, of each view's rows from their pixels, and the camera of each view."""

    medians: np.ndarray  # [s,v] in the camera that is s places before the view; inf where there is no such camera
    cameras: np.ndarray  # [v], -1 for a view that no camera fits


def _find_fits(source: RowSource, grid: Grid) -> _Fits | None:
    """Find the stored camera of each view of rows in order; None if all or none fit, or a camera is a little off."""
    views, remainder = divmod(len(source.ply.gaussians), math.prod(grid.size))
    is_possible = source.scale is None and source.may_be("view-major") and not remainder
    if not is_possible or not _MOST * views <= len(grid.cameras) <= views:
        return None
    medians = _measure(source, grid, views)
    cameras = _choose_cameras(medians, pixel_limit(*grid.size))
    others = medians[:, cameras < 0]
    are_far = bool((others > max_pixels(*grid.size)).all())
    return _Fits(medians, cameras) if 0 < others.shape[1] < views and are_far else None


def _measure(source: RowSource, grid: Grid, views: int) -> np.ndarray:
    """Measure the median distance, pixels, of each view's rows from their pixels in the cameras that it may have.

    Returns ``[s,v]`` for cameras that are ``s`` places before the view; inf where there is no such camera.
    """
    last = len(grid.cameras) - 1
    pairs = source.inputs(grid, photos=False).pairs(sample_layout(plain_layout(views, *grid.size)))
    medians = np.full((views - last, views), np.inf)
    for skipped in range(len(medians)):
        cameras = pairs.parts - skipped
        errors = pixel_errors(replace(pairs, views=cameras.clip(0, last)), grid.cameras)
        for view, view_errors in enumerate(pairs.split(errors, views)):
            if 0 <= view - skipped <= last:
                medians[skipped, view] = np.quantile(view_errors, 0.5, method="lower") if len(view_errors) else np.nan
    return medians


def _choose_cameras(medians: np.ndarray, limit: float) -> np.ndarray:
    """Choose the camera ``[v]`` of each view, in the order of the views; -1 for a view that no camera fits."""
    cameras, skipped = np.full(medians.shape[1], -1), 0
    for view in range(len(cameras)):
        fitting = skipped + np.flatnonzero(medians[skipped:, view] < limit)
        if len(fitting):
            skipped = int(fitting[0])
            cameras[view] = view - skipped
    return cameras


def _describe(grid: Grid, fits: _Fits, *, is_left_out: bool) -> tuple[str, ...]:
    """Note the views without a camera that fits, and the cameras that fit no view, which may be left out."""
    num_views, names, notes = len(fits.cameras), grid.camera_file.names, []
    wrong = [camera for camera in range(len(names)) if camera not in fits.cameras]
    count = num_views - len(names)
    if count:
        has, its = ("has", "its") if count == 1 else ("have", "their")
        notes += [f"{count} of {num_views} views in the file {has} no camera: {its} Gaussians belong to no pixels"]
    if wrong:
        usual = float(np.median(fits.medians.min(0)[fits.cameras >= 0]))
        px = max(min(row[camera + skipped] for skipped, row in enumerate(fits.medians)) for camera in wrong)
        which = list_some([names[camera] for camera in wrong])
        subject, verb = ("camera of 1", "does") if len(wrong) == 1 else (f"cameras of {len(wrong)}", "do")
        views = "that view is" if len(wrong) == 1 else "these views are"
        effect = f"{views} left out" if is_left_out else "no row gets a pixel"
        notes += [
            f"the {subject} of {num_views} views {verb} not fit the Gaussians there, so {effect}: {which} (up to"
            f" {px:.3g} px from their pixels, other views {usual:.2g} px); give the right cameras"
        ]
    return tuple(notes)
