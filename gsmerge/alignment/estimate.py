"""Estimate cameras where no file gives any: from a grid alone, or, with pixels dropped, from photos as well.

Depth Anything 3 drops unknown pixels. Its rows come view by view and row by row, so every stretch of them without a
gap shows the colours of a stretch of the photo. Its place there says which pixels these rows are; they give the
cameras, the cameras all others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsmerge.alignment.calibration import calibrate
from gsmerge.alignment.layouts import (
    DEPTH_SHARE,
    ESTIMATED,
    WITH_PHOTOS,
    Layout,
    da3_box,
    every_nth,
    exact_layouts,
    patch_grids,
    subsample,
)
from gsmerge.alignment.row_grid import find_grid
from gsmerge.alignment.score import MARGIN, find_correspondences
from gsmerge.alignment.stretches import UNIQUE, base_colors, byte_colors, place_stretch, shown_colors
from gsmerge.io.cameras.camera_file import W2C_OPENCV, CameraFile, View, make_camera_file
from gsmerge.io.photo_files import Photos, PhotoTransform, Size, resize_to
from gsmerge.types import Cameras, Gaussians

_GRID_SAMPLES = 300  # Gaussians per view that cameras are estimated from
_STRETCH = 96  # rows that are compared with a photo
_STRETCHES = 60  # of a view
_PER_STRETCH = 12  # rows of each that cameras are estimated from
_SLACK = 8  # pixels more than the bounds on both sides that are searched
_MAX_COST = 3.0  # times the distance of the nearest quarter of a view's stretches
_BACK = 1  # pixels that one stretch may lie too far ahead of the next
_MIN_STRETCHES, _MIN_AGREEING = 8, 0.5  # of a view that agree, and share of the unique ones


def estimate_cameras(
    path: Path, gaussians: Gaussians, valid: np.ndarray, names: Sequence[str], width: int, height: int
) -> CameraFile | None:
    """Estimate cameras that show each row of a full or trimmed grid in its own pixel.

    ``names`` are the names of the views, all of ``width`` x ``height`` pixels; ``valid [n]`` bool; ``path`` is for
    messages. None if no order of the rows fits at least twice as well as all other orders.
    """
    layouts = exact_layouts(len(gaussians), len(names), width, height)
    possible = [layout for layout in layouts if layout.per_pixel == 1 and len(layout.views) == len(names)]
    samples = (find_correspondences(gaussians.means, valid, subsample(layout, _GRID_SAMPLES)) for layout in possible)
    fits = [fit for pairs in samples if (fit := calibrate(pairs, width, height)) is not None]
    fits.sort(key=lambda fit: fit.worst_px)
    if not fits or (len(fits) > 1 and fits[1].worst_px < MARGIN * fits[0].worst_px):
        return None
    return _make_cameras(path, ESTIMATED, names, fits[0].cameras)


def estimate_from_rows(path: Path, gaussians: Gaussians, valid: np.ndarray) -> tuple[CameraFile, np.ndarray] | None:
    """Estimate the cameras of rows that form a grid of unknown size; None where rows form no grid.

    ``valid [n]`` bool; ``path`` is for messages. Also returns the base colours ``[v,h,w,3]`` of the pixels, 0 to 1.
    """
    grid = find_grid(gaussians, valid)
    if grid is None:
        return None
    layout, calibration = grid
    names = [f"view {view}" for view in range(len(calibration.cameras))]
    base = base_colors(gaussians)
    firsts = [layout.views.index(view) for view in range(len(names))]
    pictures = np.stack([base[layout.rows[first]].reshape(layout.height, layout.width, 3) for first in firsts])
    return _make_cameras(path, ESTIMATED, names, calibration.cameras), pictures


def _make_cameras(path: Path, source: str, names: Sequence[str], cameras: Cameras) -> CameraFile:
    """Make the camera file of estimated cameras."""
    posed = zip(names, cameras.viewmats[:, :3], cameras.Ks, strict=True)
    views = [View(name, pose, K, (cameras.width, cameras.height)) for name, pose, K in posed]
    return make_camera_file(path, source, W2C_OPENCV, views)


@dataclass(frozen=True)
class _Grid:
    """A size of the pictures that the model may have seen, and the views it may have written."""

    transform: PhotoTransform
    views: tuple[int, ...]

    @property
    def inside(self) -> np.ndarray:
        """Pixels ``[m]`` of the kept box, row by row."""
        width, height = self.transform.width, self.transform.height
        return da3_box(width, height).pixels(width, height).reshape(-1)

    @property
    def bounds(self) -> tuple[int, int]:
        """Fewest and most rows of a view, by whether its farthest pixels lie in the box."""
        pixels, box = self.transform.width * self.transform.height, len(self.inside)
        return box - (pixels - int(DEPTH_SHARE * (pixels - 1)) - 1), box


def _possible_grids(count: int, views: int, size: Size) -> Iterator[_Grid]:
    """Yield the grids in which the views can have ``count`` rows in all, for photos of one size."""
    for transform in (resize_to(size, size), *patch_grids(size)):
        for chosen in every_nth(views):
            grid = _Grid(transform, chosen)
            fewest, most = grid.bounds
            if fewest * len(chosen) <= count <= most * len(chosen):
                yield grid


def estimate_with_photos(
    path: Path,
    gaussians: Gaussians,
    valid: np.ndarray,
    names: Sequence[str],
    size: Size,
    read_photos: Callable[[], Photos],
) -> CameraFile | None:
    """Estimate the cameras of a file that lacks unknown pixels, from the colours of its photos.

    ``names`` are the names of the photos, which all have one ``size``; ``valid [n]`` bool; ``path`` is for messages.
    None where colours and rows do not agree.
    """
    grids = list(_possible_grids(len(gaussians), len(names), size))
    if not grids:
        return None
    photos = read_photos()
    colors = byte_colors(gaussians)
    for grid in grids:
        layout = _match_colors(colors, grid, grid.transform.photos(photos))
        if layout is not None:
            pairs = find_correspondences(gaussians.means, valid, layout)
            solved = calibrate(pairs, layout.width, layout.height)
            if solved is not None:
                return _make_cameras(path, WITH_PHOTOS, [names[view] for view in grid.views], solved.cameras)
    return None


def _match_colors(colors: np.ndarray, grid: _Grid, photos: Photos) -> Layout | None:
    """Find the pixels of a sample of rows in each view by their ``colors [3,n]``; None if too few are found."""
    inside, (fewest, _) = grid.inside, grid.bounds
    dropped = len(inside) - fewest  # pixels of a view, at most
    length = min(_STRETCH, grid.transform.width)
    first, unsure = 0, 0  # row that the view begins with, and by how many that may be wrong
    rows, pixels = [], []
    for view in grid.views:
        shown = shown_colors(photos[view], inside, length)
        last = min(first + len(inside), colors.shape[1]) - length
        matches = []
        for start in np.unique(np.linspace(first + unsure // 2, last, _STRETCHES).astype(int)):
            low = max(0, start - first - unsure - _SLACK)
            high = min(len(inside), start - first + unsure + dropped + _SLACK)
            if start >= 0 and low < high:
                matches.append((start, *place_stretch(shown, colors[:, start : start + length], low, high)))
        placed = _choose_agreeing(np.array(matches, np.int64).reshape(-1, 4))
        if not len(placed):
            return None
        within = np.linspace(0, length - 1, _PER_STRETCH).astype(int)
        rows.append((placed[:, :1] + within).reshape(-1))
        pixels.append(inside[(placed[:, 1:2] + within).clip(max=len(inside) - 1)].reshape(-1))
        start, place = (int(value) for value in placed[-1, :2])
        left = max(0, len(inside) - place - length)
        first = start + length + left // 2
        unsure = left // 2 + length
    width, height = grid.transform.width, grid.transform.height
    views = tuple(range(len(grid.views)))
    return Layout("", "pruned", "view-major", width, height, views, tuple(rows), tuple(pixels))


def _choose_agreeing(stretches: np.ndarray) -> np.ndarray:
    """Choose the stretches ``[s,4]`` that are unique and in order; none if few are.

    Their columns are row, place, sum and the next best sum.
    """
    if not len(stretches):
        return stretches
    near = stretches[:, 2] <= _MAX_COST * max(1.0, float(np.quantile(stretches[:, 2], 0.25)))
    stretches = stretches[near & (stretches[:, 3] > UNIQUE * stretches[:, 2])]
    gaps = stretches[:, 1] - stretches[:, 0]  # pixels dropped so far and a constant: never fewer
    longest, before = np.ones(len(stretches), int), np.full(len(stretches), -1)
    for i in range(len(stretches)):
        earlier = np.flatnonzero(gaps[:i] <= gaps[i] + _BACK)
        if len(earlier):
            before[i] = earlier[longest[earlier].argmax()]
            longest[i] = longest[before[i]] + 1
    chain, i = [], int(longest.argmax()) if len(stretches) else -1
    while i >= 0:
        chain.append(i)
        i = int(before[i])
    enough = max(_MIN_STRETCHES, _MIN_AGREEING * len(stretches))
    return stretches[chain[::-1]] if len(chain) >= enough else stretches[:0]
