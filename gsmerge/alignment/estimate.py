"""Estimate cameras where no file gives any: from a full grid alone, or, with pixels dropped, from photos as well.

Depth Anything 3 drops unknown pixels. Its rows come view by view and row by row, so every stretch of them without a
gap shows the colours of a stretch of the photo. Its place there says which pixels these rows are; they give the
cameras, the cameras all others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gsmerge.alignment.layouts import DEPTH_SHARE, Layout, da3_box, every_nth, exact_layouts, patch_grids, subsample
from gsmerge.alignment.resection import projection_errors, refine_poses, start_pose
from gsmerge.alignment.score import MARGIN, Correspondences, find_correspondences, pixel_limit
from gsmerge.alignment.stretches import UNIQUE, byte_colors, place_stretch, shown_colors
from gsmerge.geometry import project_points
from gsmerge.io.cameras.camera_file import W2C_OPENCV, CameraFile, View, make_camera_file, make_pinhole
from gsmerge.io.photo_files import Photos, PhotoTransform, Size, resize_to
from gsmerge.kernels.matrices import matmul
from gsmerge.types import Cameras, Gaussians

ESTIMATED = "estimated from the grid"  # source of estimated cameras
_GRID_SAMPLES = 300  # Gaussians per view that cameras are estimated from
_CALIBRATIONS = 2  # each time without the Gaussians that lie far from their pixels
WITH_PHOTOS = "estimated from rows and photos"  # of the cameras
_STRETCH = 96  # rows that are compared with a photo
_STRETCHES = 60  # of a view
_PER_STRETCH = 12  # rows of each that cameras are estimated from
_SLACK = 8  # pixels more than the bounds on both sides that are searched
_MAX_COST = 3.0  # times the distance of the nearest quarter of a view's stretches
_BACK = 1  # pixels that one stretch may lie too far ahead of the next
_MIN_STRETCHES, _MIN_AGREEING = 8, 0.5  # of a view that agree, and share of the unique ones
_ROUNDS = 4  # of cameras and of the shape of their pixels
_OWN_FOCALS = 1.3  # times nearer with a focal length for each view


def estimate_cameras(
    path: Path, gaussians: Gaussians, valid: np.ndarray, names: Sequence[str], width: int, height: int
) -> CameraFile | None:
    """Estimate poses and one focal length so that the rows of a full or trimmed grid project into their own pixels.

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
    """Calibrate cameras for one row order: (largest median distance in pixels, focal length, poses); inf on failure.

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
    start_poses = [pose for pose in starts if pose is not None]
    if len(start_poses) < len(starts):
        return math.inf, 0.0, []
    poses = np.stack(start_poses)
    for _ in range(_CALIBRATIONS):
        near, where = ([p[k] for p, k in zip(values, kept, strict=True)] for values in (points, pixels))
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
        """Fewest and most rows that a view has, by whether the farthest pixels lie in the box."""
        pixels, box = self.transform.width * self.transform.height, len(self.inside)
        return box - (pixels - int(DEPTH_SHARE * (pixels - 1)) - 1), box


def _possible_grids(count: int, views: int, size: Size) -> Iterator[_Grid]:
    """Yield the grids whose views can have ``count`` rows, for photos of one size."""
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
    """Estimate the cameras of a file with unknown missing pixels, from the colours of its photos.

    ``names`` are those of the photos, which have one ``size``; ``valid [n]`` bool; ``path`` is for
    messages. None where colours and rows do not agree.
    """
    grids = list(_possible_grids(len(gaussians), len(names), size))
    if not grids:
        return None
    photos = read_photos()
    colors = byte_colors(gaussians)
    for grid in grids:
        layout = _match_colors(colors, grid, grid.transform.photos(photos))
        cameras = None if layout is None else _solve(gaussians, valid, layout, grid)
        if cameras is not None:
            size = cameras.width, cameras.height
            views = [
                View(names[view], cameras.viewmats[block, :3], cameras.Ks[block], size)
                for block, view in enumerate(grid.views)
            ]
            return make_camera_file(path, WITH_PHOTOS, W2C_OPENCV, views)
    return None


def _match_colors(colors: np.ndarray, grid: _Grid, photos: Photos) -> Layout | None:
    """Find pixels of some rows of each view by their ``colors [3,n]``, or None if they are too few."""
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
        placed = _agreeing(np.array(matches, np.int64).reshape(-1, 4))
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
    blocks = tuple(range(len(grid.views)))
    return Layout("", "pruned", "view-major", width, height, blocks, tuple(rows), tuple(pixels))


def _agreeing(stretches: np.ndarray) -> np.ndarray:
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


def _solve(gaussians: Gaussians, valid: np.ndarray, layout: Layout, grid: _Grid) -> Cameras | None:
    """Solve for the cameras from the rows whose pixels are known; None where they do not fit."""
    aspect = grid.transform.scale_y / grid.transform.scale_x
    pairs = find_correspondences(gaussians.means, valid, layout)
    for _ in range(_ROUNDS):
        _, cameras = _calibrate(gaussians, valid, layout, aspect, alone=False)
        if cameras is None:
            return None
        aspect *= _stretch(pairs, cameras)
    worst, cameras = _calibrate(gaussians, valid, layout, aspect, alone=True)
    return cameras if worst <= pixel_limit(layout.width, layout.height) else None


def _calibrate(
    gaussians: Gaussians, valid: np.ndarray, layout: Layout, aspect: float, *, alone: bool
) -> tuple[float, Cameras | None]:
    """Solve for the cameras of some rows, with one focal length.

    With ``alone`` each view gets its own where that is clearly better. Returns the largest median
    distance in pixels as well, inf where there are no cameras.
    """
    worst, focal, poses = calibrate(gaussians.means, valid, layout, aspect)
    focals = [focal] * len(poses)
    views = [
        replace(layout, views=(0,), rows=(rows,), pixels=(pixels,))
        for rows, pixels in zip(layout.rows, layout.pixels, strict=True)
    ]
    fits = [calibrate(gaussians.means, valid, view, aspect) for view in views] if alone else []
    largest = max((fit[0] for fit in fits), default=math.inf)
    if largest * _OWN_FOCALS < worst:
        worst, focals, poses = largest, [fit[1] for fit in fits], [fit[2][0] for fit in fits]
    if not math.isfinite(worst):
        return math.inf, None
    width, height = layout.width, layout.height
    Ks = np.stack([make_pinhole(focal, aspect * focal, width / 2, height / 2) for focal in focals])
    viewmats = np.stack([np.vstack([pose, [0, 0, 0, 1]]) for pose in poses])
    return worst, Cameras(viewmats, Ks, width, height)


def _stretch(pairs: Correspondences, cameras: Cameras) -> float:
    """Measure how much taller the pixels of pictures must be to fit the rows."""
    viewmats, Ks = cameras.viewmats[pairs.views], cameras.Ks[pairs.views]
    with np.errstate(all="ignore"):  # rows in a camera's plane, which are left out
        xy, _ = project_points(pairs.points[:, None], viewmats, Ks)
    middle = np.array([cameras.width, cameras.height]) / 2
    seen, wanted = xy[:, 0] - middle, pairs.pixels - middle
    error = np.linalg.norm(seen - wanted, axis=1)
    near = error <= max(1.0, 3 * float(np.nanmedian(error)))
    x, y = (seen[near] * wanted[near]).sum(0) / (seen[near] ** 2).sum(0)
    return float(y / x)
