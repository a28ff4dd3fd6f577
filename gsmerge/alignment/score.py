"""Measure how near Gaussians project to their pixels, and how near their colours are to the colours of the photos."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from gsmerge.alignment.layouts import Layout, plain_layout, spread_step, subsample
from gsmerge.geometry import Similarity, lower_median, median, sh0_to_rgb
from gsmerge.kernels import reproject
from gsmerge.runtime.memory import free_pages, gather
from gsmerge.types import Cameras, Gaussians, Scene

MARGIN = 2.0  # factor by which the best alternative must beat the next one
SHUFFLED_MARGIN = 5.0  # factor by which the best alternative must beat shuffled pixels
# Two medians of some 400 distances differ by chance. The standard error of a median distance in a plane is
# 0.72 / sqrt(n) of the median, so a ratio of 1.15 is three standard errors. Files round the numbers of cameras, which
# displaces projections by up to 0.02 pixels
AS_NEAR, AS_NEAR_PX = 1.15, 0.02
# Colour error, divided by the colour error of shuffled pixels. Above this share colours agree no better than at random
RANDOM_SHARE = 0.85
SAME_COLORS = 0.01  # colour error of shuffled pixels below which colours vary too little to decide
QUICK_GAUSSIANS, SAMPLE_GAUSSIANS = 1500, 6000  # Gaussians of a quick score, and of a score
MIN_SAMPLE_GAUSSIANS = 60  # of each part
MAX_CHECKED = 5_000  # pixels per view that an alignment is checked on
MAX_MEDIAN_PX = 1.5  # backbones move a Gaussian within its pixel, and some of them a little beyond


@dataclass(frozen=True, eq=False)
class Correspondences:
    """t Gaussians, each with the view and the pixel to which it is assumed to belong."""

    points: np.ndarray  # ``[t,3]`` float64 means
    pixels: np.ndarray  # ``[t,2]`` pixel centres (x, y)
    views: np.ndarray  # ``[t]`` ids of the cameras
    parts: np.ndarray  # ``[t]`` the part of the layout: a view, or one layer of a view; ascending
    rows: np.ndarray  # ``[t]`` rows of the file

    def select(self, index: np.ndarray) -> Correspondences:
        """Select rows by a mask or indices."""
        return Correspondences(*(column[index] for column in vars(self).values()))

    def split(self, values: np.ndarray, parts: int) -> list[np.ndarray]:
        """Split ``values [t,...]`` into one array per part."""
        return np.split(values, np.cumsum(np.bincount(self.parts, minlength=parts))[:-1])


def pixel_errors(pairs: Correspondences, cameras: Cameras) -> np.ndarray:
    """Measure the distances ``[t]``, pixels, of projected Gaussians from their pixel centres; inf behind a camera."""
    errors = np.empty(len(pairs.views))
    values = pairs.points, cameras.viewmats, cameras.Ks, pairs.pixels
    points, viewmats, Ks, pixels = (np.ascontiguousarray(array, np.float64) for array in values)
    reproject.pixel_errors(points, np.ascontiguousarray(pairs.views, np.int64), viewmats, Ks, pixels, errors)
    return errors


@dataclass(frozen=True, eq=False)
class AlignmentInput:
    """Input of the search for pixels: rows, cameras, photos and hints."""

    gaussians: Gaussians  # the file's n rows
    valid: np.ndarray  # ``[n]`` bool
    cameras: Cameras  # all c cameras at the grid's size, in their own world
    images: np.ndarray  # ``[c,h,w,3]`` photos; [0,...] without any
    order: str = "auto"  # the order of the rows if it is given, otherwise "auto"
    scale: float | None = None  # length of one unit of the cameras' world in the Gaussians' world, if given

    def pairs(self, layout: Layout) -> Correspondences:
        """Return the valid rows of a layout with their pixels and views."""
        return find_correspondences(self.gaussians.means, self.valid, layout)


def find_correspondences(means: np.ndarray, valid: np.ndarray, layout: Layout) -> Correspondences:
    """Return the valid rows of a layout, with their pixels and views.

    ``means [n,3]`` belong to all n rows of the file. Rows that are False in ``valid [n]`` are left out.
    """
    rows, pixels = np.concatenate(layout.rows), np.concatenate(layout.pixels)
    parts = np.repeat(np.arange(len(layout.views)), [len(part_rows) for part_rows in layout.rows])
    is_valid = valid[rows]
    rows, pixels, parts = rows[is_valid], pixels[is_valid], parts[is_valid]
    y, x = np.divmod(pixels, layout.width)
    points = gather(means, rows).astype(np.float64)
    return Correspondences(points, np.stack([x, y], 1) + 0.5, np.array(layout.views)[parts], parts, rows)


@dataclass(frozen=True)
class Alignment:
    """Distance of projected Gaussians from their pixels, in each view, or in each part of the rows."""

    # median distance from the pixel centre, pixels; inf if most Gaussians are behind the camera, NaN if none is finite
    median_px: tuple[float, ...]
    share_in_front: float  # share of all checked Gaussians with positive depth in their own view
    share_within_1px: float  # share of all checked Gaussians at most one pixel from their pixel's centre
    limit_px: float  # largest median that counts as aligned
    ok: bool  # True if every view's median is below the limit and most Gaussians are in front

    @property
    def middle_px(self) -> float:
        """Median of the views' median distances, pixels."""
        return float(lower_median(np.array([px for px in self.median_px if not math.isnan(px)] or [math.inf])))

    @property
    def worst_px(self) -> float:
        """Largest of the views' median distances, pixels."""
        return max((px for px in self.median_px if not math.isnan(px)), default=math.nan)


@dataclass(frozen=True)
class ScoredLayout:
    """A layout of the rows in a frame, and how well it fits."""

    layout: Layout  # the assumed pixel of each row
    frame: Similarity  # from the frame of the cameras to the frame of the Gaussians
    alignment: Alignment  # distance of the Gaussians of each part from their pixels
    effort: int = 0  # 0: the frame is an exporter's; 1: its scale or shift was solved for; 2: its rotation as well

    @property
    def description(self) -> str:
        """Description of layout and frame in words."""
        return ", ".join(filter(None, (self.layout.description, self.frame.description)))


def is_as_near(px: float, least: float) -> bool:
    """Return True if a median distance, pixels, equals the least distance up to chance and rounding."""
    return px <= max(AS_NEAR * least, least + AS_NEAR_PX)


def is_clearly_nearer(px: float, other_px: float) -> bool:
    """Return True if a median distance, pixels, is clearly smaller than ``other_px`` of another layout or frame."""
    return other_px >= MARGIN * max(px, AS_NEAR_PX)


def pixel_limit(width: int, height: int) -> float:
    """Return the largest median distance, pixels, at which Gaussians count as lying in their pixels."""
    return max(0.5, min(MAX_MEDIAN_PX, 0.1 * math.sqrt(width * height)))


def sample_layout(layout: Layout, samples: int = SAMPLE_GAUSSIANS) -> Layout:
    """Thin a layout to a sample of rows for scoring."""
    return subsample(layout, max(MIN_SAMPLE_GAUSSIANS, samples // len(layout.views)))


def score_layout(
    inputs: AlignmentInput, layout: Layout, frame: Similarity, pairs: Correspondences | None = None
) -> ScoredLayout:
    """Score how well a layout fits in a frame, on a sample of its rows or on the given ``pairs``."""
    if pairs is None:
        pairs = inputs.pairs(sample_layout(layout))
    return ScoredLayout(layout, frame, check_pairs(pairs, frame.move(inputs.cameras), len(layout.views)))


def score_shuffled(inputs: AlignmentInput, best: ScoredLayout) -> tuple[float, float]:
    """Measure the median distance in pixels and the mean colour error after shuffling the pixels in each part."""
    rng, layout = np.random.default_rng(0), sample_layout(best.layout)
    pairs = inputs.pairs(replace(layout, pixels=tuple(rng.permutation(pixels) for pixels in layout.pixels)))
    errors = pixel_errors(pairs, best.frame.move(inputs.cameras))
    return median(errors), _color_distance(inputs, pairs)


def beats_shuffled(scored: ScoredLayout, shuffled_px: float) -> bool:
    """Return True if a layout is near enough to its pixels, and far nearer than to shuffled pixels."""
    return scored.alignment.ok and shuffled_px >= SHUFFLED_MARGIN * max(scored.alignment.worst_px, AS_NEAR_PX)


def color_error(inputs: AlignmentInput, layout: Layout) -> float:
    """Measure the mean difference, 0 to 1, between base colours and the photos at a layout's pixels.

    NaN without photos, without rows, or if all Gaussians have one colour.
    """
    return _color_distance(inputs, inputs.pairs(sample_layout(layout)))


def _color_distance(inputs: AlignmentInput, pairs: Correspondences) -> float:
    if not len(pairs.rows):
        return math.nan
    base = sh0_to_rgb(gather(inputs.gaussians.sh0, pairs.rows)[:, 0])
    if (base == base[0]).all():  # Gaussians made from depth maps without images have one colour
        return math.nan
    x, y = pairs.pixels.astype(np.int64).T
    colors = photo_colors(inputs.images, pairs.views, y, x)
    return float(np.abs(base.clip(0, 1) - colors).mean(1).mean())


def base_colors(gaussians: Gaussians) -> np.ndarray:
    """Return the base colours ``[n,3]`` of Gaussians, 0 to 1; 0 for NaN."""
    with np.errstate(invalid="ignore"):
        return np.nan_to_num(sh0_to_rgb(gaussians.sh0[:, 0])).clip(0, 1)


def photo_colors(images: np.ndarray, views: np.ndarray, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Look up the colours ``[t,3]`` of photos ``[c,h,w,3]`` at the given pixels; NaN without photos."""
    return gather(images, views, y, x) if len(images) else np.full((len(x), 3), np.nan, np.float32)


def check_alignment(gaussians: Gaussians, cameras: Cameras, valid: np.ndarray) -> Alignment:
    """Measure how far a sample of Gaussians in every view projects from their own pixels.

    ``gaussians`` are V·H·W rows, view by view and line by line. Rows that are False in ``valid [V·H·W]`` (or
    ``[V,H,W]``) are left out. Raises ValueError for another number of rows.
    """
    free_pages(vars(gaussians).values())
    return check_pairs(sample_pixels(gaussians, cameras, valid), cameras)


def sample_pixels(gaussians: Gaussians, cameras: Cameras, valid: np.ndarray) -> Correspondences:
    """Return the sample of Gaussians and pixels that :func:`check_alignment` measures."""
    views, width, height = len(cameras), cameras.width, cameras.height
    if len(gaussians) != views * height * width:
        raise ValueError(f"expected {views} x {height} x {width} Gaussians, got {len(gaussians)}")
    layout = plain_layout(views, width, height)
    return find_correspondences(gaussians.means, valid.reshape(-1), subsample(layout, MAX_CHECKED))


def check_pixels(scene: Scene) -> Alignment:
    """Measure how far Gaussians project from their pixels, at a sample of the pixels of every view.

    Only the foremost Gaussian of a pixel counts.
    """
    free_pages(vars(scene.gaussians).values())
    width, views = scene.cameras.width, len(scene)
    step = spread_step(-(-scene.pixels_per_view // MAX_CHECKED), width)
    sample = np.arange(0, scene.pixels_per_view, step)
    fronts = scene.get_pixels().fronts.reshape(views, -1)[:, sample]
    parts, columns = np.nonzero(fronts >= 0)
    y, x = np.divmod(sample[columns], width)
    rows = fronts[parts, columns]
    points = gather(scene.gaussians.means, rows).astype(np.float64)
    return check_pairs(Correspondences(points, np.stack([x, y], 1) + 0.5, parts, parts, rows), scene.cameras)


def check_pairs(pairs: Correspondences, cameras: Cameras, num_parts: int | None = None) -> Alignment:
    """Measure how near Gaussians project to their pixels, in each of ``num_parts`` parts; None: one part per view."""
    limit = pixel_limit(cameras.width, cameras.height)
    errors = pixel_errors(pairs, cameras)
    medians = tuple(
        float(np.quantile(part_errors, 0.5, method="lower")) if len(part_errors) else math.nan
        for part_errors in pairs.split(errors, len(cameras) if num_parts is None else num_parts)
    )
    count = max(1, len(errors))
    in_front, within_1px = float(np.isfinite(errors).sum()) / count, float((errors <= 1).sum()) / count
    is_near = [median_px < limit for median_px in medians if not math.isnan(median_px)]
    return Alignment(medians, in_front, within_1px, limit, bool(is_near) and all(is_near) and in_front > 0.5)
