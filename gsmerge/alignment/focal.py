"""Estimate the focal length of cameras whose file has only poses.

If rows are pixels, the focal length follows from their rays. Under a given pose, the coordinate of a pixel is a linear
function of the slope of the direction to its Gaussian. The factor is the focal length, and the coordinate at slope 0 is
the principal point. Otherwise many focal lengths are tried; at the right one, Gaussians project to pixels of their own
colours in the photos.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path

import numpy as np

from gsmerge.alignment.cameras import fit_lines, other_conventions
from gsmerge.alignment.estimate import estimate_cameras
from gsmerge.alignment.grids import shown_sizes
from gsmerge.alignment.layouts import exact_layouts, subsample, view_orders
from gsmerge.alignment.row_grid import find_layouts
from gsmerge.alignment.score import Correspondences, find_correspondences, is_clearly_nearer, pixel_limit
from gsmerge.alignment.unaligned import CameraCheck, check_cameras
from gsmerge.geometry import is_inside, project_points, sh0_to_rgb
from gsmerge.io.cameras.camera_file import CameraFile, make_pinhole
from gsmerge.io.formats.read import GaussianFile
from gsmerge.io.photo_files import PhotoArrays, PhotoTransform, Size, as_floats, photo_size, resize_to
from gsmerge.kernels.matrices import transform
from gsmerge.kernels.pictures import sample_bilinear
from gsmerge.types import Cameras, Gaussians

_GRID_GAUSSIANS = 500  # Gaussians per view that intrinsics are solved from
_MAX_UNEVEN = 1.5  # largest ratio of the two focal lengths
_MAX_VIEWS = 12  # number of photos that are compared with the Gaussians
_SIDE = 256  # longer side of these photos, pixels
_SHORTEST = 0.25  # shortest focal length that is tried, divided by the photo's longer side
_STEP = 1.06  # ratio of neighbouring focal lengths that are tried
_STEPS = 48  # number of focal lengths that are tried; the last is four times the longer side
_FEW_GAUSSIANS = 3000  # Gaussians that are compared with the photos at each of these focal lengths
_SAMPLE_GAUSSIANS = 20_000  # Gaussians that are compared near the best focal length
_SPANS = (0.3, 0.08, 0.02, 0.005, 0.00125)  # ranges around the best that are searched in turn, in focal lengths
_STRIDES = 0, 1, 2, 4  # multiples of a round's change that are added, to move along a valley (Hooke and Jeeves 1961)
_ROUNDS = 16  # of search in each range, at most
_FINE, _FEWER = 0.01, 8  # in ranges above this one only every eighth Gaussian is compared
_MAX_ERROR = 0.1  # largest colour error of a Gaussian, of 1; a larger one means that the photo shows another surface
_HALF = 4  # number of steps to either side of the best
# Entries of the intrinsics that change together: both focal lengths, fx, fy, cx, cy
_ENTRIES = (((0, 0), (1, 1)), ((0, 0),), ((1, 1),), ((0, 2),), ((1, 2),))
_CHANGES = [np.array([[float((i, j) in entries) for j in range(3)] for i in range(3)]) for entries in _ENTRIES]


@dataclass(frozen=True, eq=False)
class _Pictures:
    """Small photos that are compared with the Gaussians."""

    views: list[int]  # ids of the cameras in the camera file
    images: np.ndarray  # ``[v,h,w,3]`` float32
    ratio: float  # width of a small photo, divided by the width of the original

    def pinhole(self, focal: float) -> np.ndarray:
        """Make intrinsics with one focal length, in pixels of the small photos, and a central principal point."""
        height, width = self.images.shape[1:3]
        return make_pinhole(focal, focal, width / 2, height / 2)

    def cameras(self, viewmats: np.ndarray, K: np.ndarray) -> Cameras:
        """Make cameras of poses ``[c,4,4]`` and common intrinsics ``K``, in pixels of the small photos."""
        height, width = self.images.shape[1:3]
        return Cameras(viewmats[self.views], np.tile(K, (len(self.views), 1, 1)), width, height)


def estimate_focal(ply: GaussianFile, camera_file: CameraFile, photos: PhotoArrays) -> CameraFile | None:
    """Estimate the intrinsics of cameras that have only poses; return the cameras with a note, or None if that fails.

    ``camera_file`` has only poses. ``photos`` are c photos ``[h,w,3]`` uint8, or empty.
    """
    camera_size = int(camera_file.widths[0]), int(camera_file.heights[0])
    size = photo_size(photos) or camera_size
    if min(size) <= 1:
        return None
    other_poses = other_conventions(camera_file.viewmats, camera_file.convention)
    conventions = [camera_file.viewmats, *(poses.viewmats for poses in other_poses)]
    K = _intrinsics_of_rays(ply, camera_file, conventions, size)
    evidence = "the rays of the pixels"
    if K is None and len(photos):
        K = _intrinsics_of_colors(ply, conventions, photos, size)
        evidence = "the photos' colours"
    if K is None:
        return None
    share = f"{K[0, 0] / size[0]:.4g}"
    count = len(camera_file)
    return replace(
        camera_file,
        Ks=np.tile(K, (count, 1, 1)),
        widths=np.full(count, size[0], np.int64),
        heights=np.full(count, size[1], np.int64),
        focal=f"no intrinsics were given: a focal length of {share} widths is estimated from {evidence}",
    )


def _intrinsics_of_rays(
    ply: GaussianFile, camera_file: CameraFile, conventions: list[np.ndarray], size: Size
) -> np.ndarray | None:
    """Solve for intrinsics ``[3,3]``, pixels, under which the rows of a grid lie on their rays; None if that fails.

    ``conventions`` are the poses ``[c,4,4]`` in each convention, and ``size`` is the size of the photos.
    """
    count, views, names = len(ply.gaussians), len(camera_file), camera_file.names
    for grid in _possible_sizes(ply, size):
        fits: list[tuple[float, tuple[float, ...], int]] = []
        for layout_id, layout in enumerate(exact_layouts(count, views, grid.width, grid.height)):
            if len(set(layout.views)) < views:
                continue
            for sample in subsample(layout, _GRID_GAUSSIANS).with_views_in(view_orders(names)):
                pairs = find_correspondences(ply.gaussians.means, ply.valid, sample)
                solved = (_solve_intrinsics(pairs, viewmats) for viewmats in conventions)
                fits += [(px, intrinsics, layout_id) for px, intrinsics in solved]
        fits.sort()
        if not fits or fits[0][0] > pixel_limit(grid.width, grid.height):
            continue
        px, intrinsics, best_id = fits[0]
        if all(is_clearly_nearer(px, other_px) for other_px, _, layout_id in fits if layout_id != best_id):
            fx, fy, cx, cy = intrinsics
            x, y = (cx + grid.left) / grid.scale_x, (cy + grid.top) / grid.scale_y
            return make_pinhole(fx / grid.scale_x, fy / grid.scale_y, x, y)
    estimated = estimate_cameras(Path(camera_file.path), ply.gaussians, ply.valid, names, size)  # without the poses
    return None if estimated is None else estimated.Ks[0]


def _possible_sizes(ply: GaussianFile, size: Size) -> Iterator[PhotoTransform]:
    """Yield transforms of photos to each size that the grid may have: their own size, then sizes that rows show."""
    yield resize_to(size, size)
    shapes = ((layout.width, layout.height) for layout in find_layouts(ply.gaussians, ply.valid))
    for shape in dict.fromkeys(shapes):
        yield from shown_sizes(size, shape)


def _solve_intrinsics(pairs: Correspondences, viewmats: np.ndarray) -> tuple[float, tuple[float, ...]]:
    """Solve for intrinsics (fx, fy, cx, cy) in pixels under given poses; return the error and the intrinsics.

    The error is the median distance of rows from their pixels, in the worst part of the layout. On failure it is inf,
    and the intrinsics are empty.
    """
    poses = viewmats[pairs.views]
    camera = transform(poses[:, :3, :3], pairs.points) + poses[:, :3, 3]
    in_front = camera[:, 2] > 0
    if not in_front.any() or in_front.mean() <= 0.5:
        return math.inf, ()
    slopes = camera[in_front, :2] / camera[in_front, 2:]
    (fx, fy), (cx, cy), errors = fit_lines(slopes, pairs.pixels[in_front])
    parts = pairs.parts[in_front]
    worst_px = max(float(np.median(errors[parts == part])) for part in np.unique(parts))
    focal_ratio = fx / fy if 0 < fx < math.inf and 0 < fy < math.inf else math.inf
    if not (math.isfinite(worst_px) and 1 / _MAX_UNEVEN < focal_ratio < _MAX_UNEVEN):
        return math.inf, ()
    return worst_px, (float(fx), float(fy), float(cx), float(cy))


def _intrinsics_of_colors(
    ply: GaussianFile, conventions: list[np.ndarray], photos: PhotoArrays, size: Size
) -> np.ndarray | None:
    """Search for intrinsics ``[3,3]``, pixels, under which the Gaussians have the photos' colours; None if none do."""
    pictures = _small_pictures(photos, size)
    sample = _sample(ply, _FEW_GAUSSIANS)
    focals = [_SHORTEST * max(pictures.images.shape[1:3])]
    while len(focals) < _STEPS:
        focals.append(focals[-1] * _STEP)
    for viewmats in conventions:
        checks = [_check(sample, pictures, viewmats, focal) for focal in focals]
        best = max(range(len(focals)), key=lambda i: checks[i].score)
        if checks[best].ok and not math.isnan(checks[best].color_ratio):
            K = _refine(_sample(ply, _SAMPLE_GAUSSIANS), pictures, viewmats, focals[best])
            return K * np.array([1 / pictures.ratio, 1 / pictures.ratio, 1])[:, None]
    return None


def _sample(ply: GaussianFile, count: int) -> Gaussians:
    """Sample about ``count`` finite Gaussians at equal steps over the file."""
    rows = np.flatnonzero(ply.valid)
    return ply.gaussians[rows[:: max(1, len(rows) // count)]]


def _small_pictures(photos: PhotoArrays, size: Size) -> _Pictures:
    """Select evenly spaced photos and reduce their size."""
    count = len(photos)
    views = sorted({round(view) for view in np.linspace(0, count - 1, min(count, _MAX_VIEWS))})
    ratio = min(1.0, _SIDE / max(size))
    width, height = (max(1, round(side * ratio)) for side in size)
    small = resize_to(size, (width, height))
    images = as_floats(small.photos([photos[view] for view in views]))
    return _Pictures(views, images, small.scale_x)


def _check(gaussians: Gaussians, pictures: _Pictures, viewmats: np.ndarray, focal: float) -> CameraCheck:
    """Check how well the views show the Gaussians with a focal length."""
    valid = np.ones(len(gaussians), bool)
    return check_cameras(gaussians, valid, pictures.cameras(viewmats, pictures.pinhole(focal)), pictures.images)


def _refine(gaussians: Gaussians, pictures: _Pictures, viewmats: np.ndarray, focal: float) -> np.ndarray:
    """Search for the intrinsics ``[3,3]`` with the smallest colour error, entry by entry, in ever smaller steps."""
    points = gaussians.means.astype(np.float64)
    colors = sh0_to_rgb(gaussians.sh0[:, 0]).clip(0, 1)

    def search(K: np.ndarray, span: float) -> np.ndarray:
        rows = slice(None, None, _FEWER if span > _FINE else 1)

        def color_error(K: np.ndarray) -> float:
            return _color_error(points[rows], colors[rows], pictures.cameras(viewmats, K), pictures.images)

        steps = sorted(range(-_HALF, _HALF + 1), key=abs)  # 0 first, so that equal errors change nothing
        for _ in range(_ROUNDS):
            before = K
            for change in _CHANGES:
                K = min((K + focal * span * step / _HALF * change for step in steps), key=color_error)
            if np.array_equal(K, before):
                break
            K = min((K + stride * (K - before) for stride in _STRIDES), key=color_error)
        return K

    return reduce(search, _SPANS, pictures.pinhole(focal))


def _color_error(points: np.ndarray, colors: np.ndarray, cameras: Cameras, images: np.ndarray) -> float:
    """Measure the mean error of colours ``[n,3]`` in the photos, at most 0.1 for each point and view.

    Points outside a photo have an error of 0.1. Because of the limit, hidden points count nearly the same wherever they
    project.
    """
    total = 0.0
    for view, image in enumerate(images):
        with np.errstate(all="ignore"):
            xy, depth = project_points(points, cameras.viewmats[view], cameras.Ks[view])
        inside = (depth > 0) & is_inside(xy, cameras)
        x, y = xy[inside].T - 0.5
        errors = np.abs(colors[inside] - sample_bilinear(image, x, y)).mean(1)
        total += float(np.minimum(errors, _MAX_ERROR).sum()) + _MAX_ERROR * (len(points) - len(errors))
    return total / (len(points) * len(images))
