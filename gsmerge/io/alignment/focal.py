"""Estimate the focal length of cameras whose poses alone are known.

Where rows are pixels it follows from their rays: under a pose, a pixel's place is a linear function of the slope of its
Gaussian's direction; the factor is the focal length, the place of slope 0 the principal point. Otherwise the photos
show it: under the right one, Gaussians project to places of their own colours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from gsmerge.geometry import project_points, sh0_to_rgb
from gsmerge.io.alignment.cameras import CameraCheck, check_cameras, estimate_cameras, fit_line, other_conventions
from gsmerge.io.alignment.layouts import exact_layouts, grids_of_count, subsample
from gsmerge.io.alignment.score import MARGIN, Correspondences, find_correspondences, pixel_limit
from gsmerge.io.cameras.camera_file import CameraFile, make_pinhole
from gsmerge.io.formats.ply import PlyScene
from gsmerge.io.photo_files import Photos, Size, as_floats, natural_key, photo_size, resize_to
from gsmerge.kernels.matrices import matmul
from gsmerge.kernels.pictures import sample_bilinear
from gsmerge.types import Cameras, Gaussians

_GRID_SAMPLES = 500  # Gaussians per view that a focal length is solved from
_ROUNDS = 4  # of reweighted least squares
_MAX_UNEVEN = 1.5  # of one focal length to the other
_MAX_GRIDS = 6  # smaller grids that the number of rows allows, which are tried
_MAX_VIEWS, _SIDE = 12, 256  # views whose photos are compared, and the longer side of these, pixels
_SHORTEST, _STEP, _STEPS = 0.25, 1.06, 48  # focal lengths that are compared: 0.25 to 4 times the longer side
_FEW_SAMPLES, _SAMPLES = 3000, 20_000  # Gaussians that are compared with the photos: at each of these, near the best
_SPANS, _HALF = (0.08, 0.02, 0.005, 0.00125), 4  # shares around the best that are searched next; places on each side


@dataclass(frozen=True)
class _Pictures:
    """Views whose photos are compared with the Gaussians."""

    views: list[int]  # of the camera file
    images: np.ndarray  # ``[v,h,w,3]`` float32, small
    ratio: float  # of their side to the photos'


def estimate_focal(ply: PlyScene, camera_file: CameraFile, photos: Photos | None) -> CameraFile | None:
    """Return the cameras with the focal length that fits the Gaussians, and a note of it; None where none fits.

    ``camera_file`` has poses alone; ``photos`` are its c ``[h,w,3]`` uint8. Where only they show the focal length,
    pixels are taken to be square, and the principal point to be in the middle.
    """
    own = int(camera_file.widths[0]), int(camera_file.heights[0])
    size = photo_size(photos) or own
    if min(size) <= 1:
        return None
    readings = [camera_file.viewmats]
    readings += [poses.viewmats for poses in other_conventions(camera_file.viewmats, camera_file.convention)]
    K, what = _intrinsics_of_rays(ply, camera_file, readings, size), "the rays of the pixels"
    if K is None and photos is not None:
        focal, what = _focal_of_colors(ply, readings, photos, size), "the photos' colours"
        K = None if focal is None else make_pinhole(focal, focal, size[0] / 2, size[1] / 2)
    if K is None:
        return None
    note = f"no intrinsics were given: a focal length of {K[0, 0] / size[0]:.4g} widths is estimated from {what}"
    count = len(camera_file)
    return replace(
        camera_file,
        Ks=np.tile(K, (count, 1, 1)),
        widths=np.full(count, size[0], np.int64),
        heights=np.full(count, size[1], np.int64),
        focal=note,
    )


def _intrinsics_of_rays(
    ply: PlyScene, camera_file: CameraFile, readings: list[np.ndarray], size: Size
) -> np.ndarray | None:
    """Solve for intrinsics ``[3,3]``, pixels, under which the rows of some full or trimmed grid lie on their rays."""
    count, views, names = len(ply.gaussians), len(camera_file), camera_file.names
    by_name = sorted(range(views), key=lambda view: natural_key(names[view]))
    labellings = list(dict.fromkeys((tuple(range(views)), tuple(by_name))))
    for grid in (resize_to(size, size), *islice(grids_of_count(count, views, size), _MAX_GRIDS)):
        fits: list[tuple[float, tuple[float, ...], int]] = []
        for number, layout in enumerate(exact_layouts(count, views, grid.width, grid.height)):
            if len(set(layout.views)) < views:
                continue
            some = subsample(layout, _GRID_SAMPLES)
            for labelling in labellings:
                labelled = replace(some, views=tuple(labelling[view] for view in some.views))
                pairs = find_correspondences(ply.gaussians.means, ply.valid, labelled)
                fits += [(*_solve_intrinsics(pairs, viewmats), number) for viewmats in readings]
        fits.sort()
        if not fits or fits[0][0] > pixel_limit(grid.width, grid.height):
            continue
        if all(px >= MARGIN * fits[0][0] for px, _, number in fits if number != fits[0][2]):
            fx, fy, cx, cy = fits[0][1]
            x, y = (cx + grid.left) / grid.scale_x, (cy + grid.top) / grid.scale_y
            return make_pinhole(fx / grid.scale_x, fy / grid.scale_y, x, y)
    width, height = size
    free = estimate_cameras(Path(camera_file.path), ply.gaussians, ply.valid, names, width, height)
    return None if free is None else free.Ks[0]


def _solve_intrinsics(pairs: Correspondences, viewmats: np.ndarray) -> tuple[float, tuple[float, ...]]:
    """Solve for (largest median distance of a block, (fx, fy, cx, cy)), pixels; infinite where there are none."""
    poses = viewmats[pairs.views]
    camera = matmul(poses[:, :3, :3], pairs.points[:, :, None])[..., 0] + poses[:, :3, 3]
    front = camera[:, 2] > 0
    if not front.any() or front.mean() <= 0.5:
        return math.inf, ()
    slopes, places = camera[front, :2] / camera[front, 2:], pairs.pixels[front]
    weights, away = np.ones(len(slopes)), np.zeros_like(places)
    lines = [(0.0, 0.0), (0.0, 0.0)]
    with np.errstate(all="ignore"):  # points in the camera's plane
        for _ in range(_ROUNDS):
            for axis in range(2):
                lines[axis] = fit_line(slopes[:, axis], places[:, axis], weights)
                away[:, axis] = places[:, axis] - lines[axis][0] * slopes[:, axis] - lines[axis][1]
            errors = np.sqrt((away * away).sum(1))
            weights = 1 / (1 + (errors / (3 * np.median(errors) + 1e-9)) ** 2)
    (fx, cx), (fy, cy) = lines
    blocks = pairs.blocks[front]
    worst = max(float(np.median(errors[blocks == block])) for block in np.unique(blocks))
    if not (math.isfinite(worst) and 0 < fx < math.inf and 1 / _MAX_UNEVEN < fx / fy < _MAX_UNEVEN):
        return math.inf, ()
    return worst, (fx, fy, cx, cy)


def _focal_of_colors(ply: PlyScene, readings: list[np.ndarray], photos: Photos, size: Size) -> float | None:
    """Search for the focal length, pixels, under which the Gaussians' base colours are nearest to the photos."""
    pictures = _small_pictures(photos, size)
    rows = np.flatnonzero(ply.valid)
    few, many = (ply.gaussians[rows[:: max(1, len(rows) // count)]] for count in (_FEW_SAMPLES, _SAMPLES))
    longest = max(pictures.images.shape[1:3])
    focals = [_SHORTEST * longest]
    while len(focals) < _STEPS:
        focals.append(focals[-1] * _STEP)
    for viewmats in readings:
        checks = [_check(few, viewmats[pictures.views], pictures.images, focal) for focal in focals]
        best = max(range(len(focals)), key=lambda number: checks[number].score)
        if checks[best].ok and not math.isnan(checks[best].color_ratio):
            return _refine(many, viewmats[pictures.views], pictures.images, focals[best]) / pictures.ratio
    return None


def _small_pictures(photos: Photos, size: Size) -> _Pictures:
    count = len(photos)
    views = sorted({round(number) for number in np.linspace(0, count - 1, min(count, _MAX_VIEWS))})
    ratio = min(1.0, _SIDE / max(size))
    small = resize_to(size, (max(1, round(size[0] * ratio)), max(1, round(size[1] * ratio))))
    return _Pictures(views, as_floats(small.photos([photos[view] for view in views])), small.scale_x)


def _cameras(viewmats: np.ndarray, images: np.ndarray, focal: float) -> Cameras:
    height, width = images.shape[1:3]
    Ks = np.tile(make_pinhole(focal, focal, width / 2, height / 2), (len(viewmats), 1, 1))
    return Cameras(viewmats, Ks, width, height)


def _check(gaussians: Gaussians, viewmats: np.ndarray, images: np.ndarray, focal: float) -> CameraCheck:
    return check_cameras(gaussians, np.ones(len(gaussians), bool), _cameras(viewmats, images, focal), images)


def _refine(gaussians: Gaussians, viewmats: np.ndarray, images: np.ndarray, focal: float) -> float:
    """Search ever nearer to a focal length for the one with the smallest distance of colours."""
    points = gaussians.means.astype(np.float64)
    colors = sh0_to_rgb(gaussians.sh0[:, 0]).clip(0, 1)
    for span in _SPANS:
        places = [focal * (1 + span * step / _HALF) for step in range(-_HALF, _HALF + 1)]
        focal = min(places, key=lambda place: _color_error(points, colors, _cameras(viewmats, images, place), images))
    return focal


def _color_error(points: np.ndarray, colors: np.ndarray, cameras: Cameras, images: np.ndarray) -> float:
    """Measure the mean distance of colours ``[n,3]`` from the photos wherever points ``[n,3]`` are seen."""
    errors = []
    for view, image in enumerate(images):
        with np.errstate(all="ignore"):
            xy, depth = project_points(points, cameras.viewmats[view], cameras.Ks[view])
        inside = (depth > 0) & (xy >= 0).all(1) & (xy < (cameras.width, cameras.height)).all(1)
        x, y = xy[inside].T - 0.5
        errors.append(np.abs(colors[inside] - sample_bilinear(image, x, y)).mean(1))
    every = np.concatenate(errors)
    return float(every.mean()) if len(every) else math.inf
