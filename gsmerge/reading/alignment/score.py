"""Measure how near Gaussians project to their pixels, and look up the colours of photos."""

from __future__ import annotations

import math
import sys

import numpy as np

from gsmerge.frozen import dataclass
from gsmerge.method.geometry.transforms import lower_median
from gsmerge.method.kernels import reproject
from gsmerge.reading.alignment.layouts import Layout, spread_step
from gsmerge.runtime.memory import free_pages, gather
from gsmerge.types import Cameras, Gaussians, Scene

SHUFFLED_MARGIN = 5.0  # factor by which Gaussians must be nearer to their pixels than to shuffled pixels
# Two medians of some 400 distances differ by chance. The median of n distances in a plane has a relative standard error
# of 0.72 / sqrt(n), so the ratio of two medians has a standard error of 5 %, and a ratio of 1.15 is three standard
# errors above 1. Files round the numbers of cameras, which displaces projections by up to 0.02 pixels
AS_NEAR = 1.15
AS_NEAR_PX = 0.02
# Gaussians of a score: in all views, and at least in each view
SCORED_GAUSSIANS = 6000
MIN_SCORED_GAUSSIANS = 60
MAX_CHECKED = 5_000  # pixels per view that an alignment is checked on
# Moving a camera may correct an error of up to MAX_PX pixels and up to the share MAX_SHARE of the image's side
MAX_PX = 12.0
MAX_SHARE = 0.05
MAX_MEDIAN_PX = 1.5  # networks move a Gaussian within its pixel, and some of them a little beyond


@dataclass(frozen=True, eq=False)
class Correspondences:
    """t Gaussians, each with the view and the pixel to which it is assumed to belong."""

    points: np.ndarray  # ``[t,3]`` float64 means
    pixels: np.ndarray  # ``[t,2]`` pixel centres (x, y)
    views: np.ndarray  # ``[t]`` ids of the cameras

    def select(self, index: np.ndarray) -> Correspondences:
        """Select rows by a mask or indices."""
        return Correspondences(*(column[index] for column in vars(self).values()))


def pixel_errors(pairs: Correspondences, cameras: Cameras) -> np.ndarray:
    """Measure the distances ``[t]``, pixels, of projected Gaussians from their pixel centres; inf behind a camera."""
    errors = np.empty(len(pairs.views))
    inputs = pairs.points, cameras.viewmats, cameras.Ks, pairs.pixels
    points, viewmats, Ks, pixels = (np.ascontiguousarray(array, np.float64) for array in inputs)
    reproject.pixel_errors(points, np.ascontiguousarray(pairs.views, np.int64), viewmats, Ks, pixels, errors)
    return errors


@dataclass(frozen=True, eq=False)
class AlignmentInput:
    """Input of the search for pixels: rows, cameras, photos and a hint."""

    gaussians: Gaussians  # the file's n rows
    valid: np.ndarray  # ``[n]`` bool
    cameras: Cameras  # all c cameras at the grid's size, in their own world
    images: np.ndarray  # ``[c,h,w,3]`` photos; [0,...] without any
    scale: float | None = None  # length of one unit of the cameras' world in the Gaussians' world, if given

    def pairs(self, layout: Layout, per_view: int = 0) -> Correspondences:
        """Return about ``per_view`` valid rows of each view of a layout, with their pixels and views.

        If ``per_view`` is 0, the number of rows that a score needs is returned.
        """
        per_view = per_view or max(MIN_SCORED_GAUSSIANS, SCORED_GAUSSIANS // layout.views)
        return find_correspondences(self.gaussians.means, self.valid, layout, per_view)


def find_correspondences(means: np.ndarray, valid: np.ndarray, layout: Layout, per_view: int) -> Correspondences:
    """Return about ``per_view`` rows of each view of a layout, with their pixels and views.

    ``means [n,3]`` belong to all n rows of the file. Rows that are False in ``valid [n]`` are left out.
    """
    rows, ids = layout.sample(per_view)
    rows, ids = rows[valid[rows]], ids[valid[rows]]
    views, pixels = np.divmod(ids, layout.width * layout.height)
    y, x = np.divmod(pixels, layout.width)
    return Correspondences(gather(means, rows).astype(np.float64), np.stack([x, y], 1) + 0.5, views)


@dataclass(frozen=True)
class Alignment:
    """Distances of projected Gaussians from their pixels, in each view."""

    # median distance from the pixel centre, pixels; inf if most Gaussians are behind the camera, NaN if none is finite
    median_px: tuple[float, ...]
    share_in_front: float  # share of all checked Gaussians with positive depth in their own view
    share_within_1px: float  # share of all checked Gaussians at most one pixel from their pixel's centre
    share_near: float  # share of all checked Gaussians that are near enough for moving a camera to correct them
    limit_px: float  # largest median that counts as aligned
    ok: bool  # True if every view's median is below the limit and most Gaussians are in front

    @property
    def middle_px(self) -> float:
        """Median over the views of a view's median distance, in pixels."""
        return float(lower_median(np.array([px for px in self.median_px if not math.isnan(px)] or [math.inf])))

    @property
    def worst_px(self) -> float:
        """Largest median distance of a view, in pixels."""
        return max((px for px in self.median_px if not math.isnan(px)), default=math.nan)


def is_as_near(px: float, least: float) -> bool:
    """Return True if a median distance in pixels is as small as ``least``, apart from chance and rounding."""
    return px <= max(AS_NEAR * least, least + AS_NEAR_PX)


def pixel_limit(width: int, height: int) -> float:
    """Return the largest median distance, in pixels, at which Gaussians count as lying in their pixels."""
    return max(0.5, min(MAX_MEDIAN_PX, 0.1 * math.sqrt(width * height)))


def max_correctable_px(width: int, height: int) -> float:
    """Return the largest median error, in pixels, that the move of a camera may correct."""
    return max(pixel_limit(width, height), min(MAX_PX, MAX_SHARE * math.sqrt(width * height)))


def photo_colors(images: np.ndarray, views: np.ndarray, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Look up the colours ``[t,3]`` of photos ``[c,h,w,3]`` at places ``x``, ``y`` in ``views``; NaN without photos."""
    return gather(images, views, y, x) if len(images) else np.full((len(x), 3), np.nan, np.float32)


def sample_pixels(gaussians: Gaussians, cameras: Cameras, valid: np.ndarray) -> Correspondences:
    """Return the sample of Gaussians and pixels that :func:`check_pairs` measures.

    ``gaussians`` are V·H·W rows, view by view and line by line. Rows that are False in ``valid [V·H·W]`` (or
    ``[V,H,W]``) are left out. Raises ValueError if there are not V·H·W rows.
    """
    layout = Layout(len(cameras), cameras.width, cameras.height)
    if len(gaussians) != len(cameras) * cameras.height * cameras.width:
        raise ValueError(f"expected {layout.views} x {layout.height} x {layout.width} Gaussians, got {len(gaussians)}")
    return find_correspondences(gaussians.means, valid.reshape(-1), layout, MAX_CHECKED)


def check_pixels(scene: Scene) -> Alignment:
    """Measure how far Gaussians project from their pixels, at a sample of the pixels of every view.

    Only the foremost Gaussian of a pixel counts.
    """
    free_pages(vars(scene.gaussians).values())  # earlier steps have read all rows, and a sample is enough here
    width = scene.cameras.width
    views = len(scene)
    step = spread_step(-(-scene.pixels_per_view // MAX_CHECKED), width)
    sample = np.arange(0, scene.pixels_per_view, step)
    fronts = scene.get_pixels().fronts.reshape(views, -1)[:, sample]
    seen_from, columns = np.nonzero(fronts >= 0)
    y, x = np.divmod(sample[columns], width)
    points = gather(scene.gaussians.means, fronts[seen_from, columns]).astype(np.float64)
    return check_pairs(Correspondences(points, np.stack([x, y], 1) + 0.5, seen_from), scene.cameras)


def check_pairs(pairs: Correspondences, cameras: Cameras) -> Alignment:
    """Measure how near Gaussians project to their pixels in each view; ``pairs`` are sorted by view."""
    limit = pixel_limit(cameras.width, cameras.height)
    errors = pixel_errors(pairs, cameras)
    ends = np.cumsum(np.bincount(pairs.views, minlength=len(cameras)))
    medians = tuple(
        float(np.quantile(view_errors, 0.5, method="lower")) if len(view_errors) else math.nan
        for view_errors in np.split(errors, ends[:-1])
    )
    count = max(1, len(errors))
    # points behind their camera have an infinite error, so all points with finite errors are in front
    limits = sys.float_info.max, 1, max_correctable_px(cameras.width, cameras.height)
    in_front, within_1px, near = (float((errors <= px).sum()) / count for px in limits)
    is_near = [median_px < limit for median_px in medians if not math.isnan(median_px)]
    is_ok = bool(is_near) and all(is_near) and in_front > 0.5
    return Alignment(
        medians, share_in_front=in_front, share_within_1px=within_1px, share_near=near, limit_px=limit, ok=is_ok
    )
