"""How well a reading of a file fits: where its Gaussians project to, and which colours the photos have there."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmerge.geometry import sh0_to_rgb
from gsmerge.io.alignment.layouts import Layout, plain_layout, subsample
from gsmerge.io.alignment.similarity import Correspondences, Similarity, pixel_errors
from gsmerge.types import Cameras, Gaussians

QUICK_SAMPLES, SAMPLES, MIN_SAMPLES = 1500, 6000, 60  # Gaussians that a reading is scored on; per view at least
MAX_CHECKED = 5_000  # pixels per view that an alignment is checked on
MAX_MEDIAN_PX = 1.5  # backbones move a Gaussian within its pixel, and some a little beyond


@dataclass(frozen=True)
class AlignmentInput:
    """What the pixels are recovered from."""

    gaussians: Gaussians  # the file's n rows
    valid: np.ndarray  # ``[n]`` bool
    cameras: Cameras  # all c cameras at the grid's size, in their own world
    images: np.ndarray | None  # ``[c,h,w,3]``, or None
    labellings: Sequence[Sequence[int]]  # orders that the views may be in: the file's, that of the names
    # reads ``[c,h,w]`` depth maps next to the cameras; None where there are none
    depths: Callable[[], np.ndarray | None]
    order: str = "auto"  # the order of the rows where it is given, otherwise "auto"
    scale: float | None = None  # size of the Gaussians' world in units of the cameras', where it is given


@dataclass(frozen=True)
class AlignmentScore:
    """One reading of a file, and how well it fits."""

    layout: Layout  # which row belongs to which pixel
    frame: Similarity  # from the frame of the cameras to that of the Gaussians
    median_px: float  # median distance of the projected Gaussians from their pixels; inf where most are behind
    worst_px: float  # the same of the worst view
    ok: bool  # whether it is near enough to be true

    @property
    def description(self) -> str:
        """What it is, for people."""
        return ", ".join(part for part in (self.layout.description, self.frame.description) if part)


def pixel_limit(width: int, height: int) -> float:
    """Median distance in pixels up to which Gaussians count as those of their pixels."""
    return max(0.5, min(MAX_MEDIAN_PX, 0.1 * math.sqrt(width * height)))


def sample_layout(layout: Layout, samples: int = SAMPLES) -> Layout:
    """The part of a layout that its reading is scored on."""
    return subsample(layout, max(MIN_SAMPLES, samples // len(layout.views)))


def find_correspondences(means: np.ndarray, valid: np.ndarray, layout: Layout) -> Correspondences:
    """The valid rows of a layout (``means [n,3]``, ``valid [n]``) with their pixels and views."""
    rows, pixels = np.concatenate(layout.rows), np.concatenate(layout.pixels)
    blocks = np.repeat(np.arange(len(layout.views)), [len(some) for some in layout.rows])
    good = valid[rows]
    rows, pixels, blocks = rows[good], pixels[good], blocks[good]
    y, x = np.divmod(pixels, layout.width)
    points = means[rows].astype(np.float64)
    return Correspondences(points, np.stack([x, y], 1) + 0.5, np.array(layout.views)[blocks], blocks, rows)


def score_layout(
    inputs: AlignmentInput, layout: Layout, frame: Similarity, pairs: Correspondences | None = None
) -> AlignmentScore:
    """The score of a layout in a frame, on a sample of its rows: ``pairs``, where they are at hand."""
    if pairs is None:
        pairs = find_correspondences(inputs.gaussians.means, inputs.valid, sample_layout(layout))
    errors = pixel_errors(pairs, frame.move_viewmats(inputs.cameras.viewmats), inputs.cameras.Ks)
    medians = [float(np.median(part)) for part in split_blocks(errors, pairs, len(layout.views)) if len(part)]
    median, worst = float(np.median(errors)) if len(errors) else math.inf, max(medians, default=math.inf)
    ok = bool(medians) and worst < pixel_limit(layout.width, layout.height) and bool(np.isfinite(errors).mean() > 0.5)
    return AlignmentScore(layout, frame, median, worst, ok)


def shuffled_score(inputs: AlignmentInput, best: AlignmentScore) -> tuple[float, float]:
    """Median distance, pixels, and mean distance of the colours, with a reading's pixels shuffled within each block."""
    rng, some = np.random.default_rng(0), sample_layout(best.layout)
    shuffled = replace(some, pixels=tuple(rng.permutation(pixels) for pixels in some.pixels))
    pairs = find_correspondences(inputs.gaussians.means, inputs.valid, shuffled)
    errors = pixel_errors(pairs, best.frame.move_viewmats(inputs.cameras.viewmats), inputs.cameras.Ks)
    return float(np.median(errors)), _color_distance(inputs, pairs)


def color_error(inputs: AlignmentInput, layout: Layout) -> float:
    """Mean distance of the base colours from the photos at a layout's pixels, 0 to 1; NaN without photos."""
    return _color_distance(inputs, find_correspondences(inputs.gaussians.means, inputs.valid, sample_layout(layout)))


def _color_distance(inputs: AlignmentInput, pairs: Correspondences) -> float:
    if inputs.images is None or not len(pairs.rows):
        return math.nan
    base = sh0_to_rgb(inputs.gaussians.sh0[pairs.rows, 0])
    x, y = pairs.pixels.astype(np.int64).T
    return float(np.abs(base.clip(0, 1) - inputs.images[pairs.views, y, x]).mean(1).mean())


@dataclass(frozen=True)
class Alignment:
    """How well every view's own Gaussians project into their own pixels."""

    # median distance from the pixel centre per view, pixels; inf where most are behind the camera, NaN where a view has
    # no finite Gaussian
    median_px: tuple[float, ...]
    share_in_front: float  # share of all checked Gaussians with positive depth in their own view
    share_within_1px: float  # share of all checked Gaussians at most one pixel from their pixel's centre
    limit_px: float  # largest median that counts as aligned
    ok: bool  # whether every view's median is below the limit and most Gaussians are in front

    @property
    def worst_px(self) -> float:
        """The largest median of a view."""
        return max((m for m in self.median_px if not math.isnan(m)), default=math.nan)


def check_alignment(gaussians: Gaussians, cameras: Cameras, valid: np.ndarray) -> Alignment:
    """Project a sample of every view's own Gaussians into that view.

    ``gaussians`` are V·H·W rows, assumed to be in view-major, row-major order; rows that are False in ``valid [V·H·W]``
    (or ``[V,H,W]``) are left out. ValueError if the number of rows is another.
    """
    return check_pairs(sample_pixels(gaussians, cameras, valid), cameras)


def sample_pixels(gaussians: Gaussians, cameras: Cameras, valid: np.ndarray) -> Correspondences:
    """The sample of :func:`check_alignment`."""
    views, width, height = len(cameras), cameras.width, cameras.height
    if len(gaussians) != views * height * width:
        raise ValueError(f"expected {views} x {height} x {width} Gaussians, got {len(gaussians)}")
    layout = plain_layout(views, width, height)
    return find_correspondences(gaussians.means, valid.reshape(-1), subsample(layout, MAX_CHECKED))


def check_pairs(pairs: Correspondences, cameras: Cameras) -> Alignment:
    """:func:`check_alignment` of a sample under cameras that may be others."""
    limit = pixel_limit(cameras.width, cameras.height)
    errors = pixel_errors(pairs, cameras.viewmats, cameras.Ks)
    medians = tuple(
        float(np.quantile(part, 0.5, method="lower")) if len(part) else math.nan
        for part in split_blocks(errors, pairs, len(cameras))
    )
    count = max(1, len(errors))
    in_front, near = float(np.isfinite(errors).sum()) / count, float((errors <= 1).sum()) / count
    fits = [median < limit for median in medians if not math.isnan(median)]
    return Alignment(medians, in_front, near, limit, bool(fits) and all(fits) and in_front > 0.5)


def split_blocks(errors: np.ndarray, pairs: Correspondences, count: int) -> list[np.ndarray]:
    """The errors of each of ``count`` blocks."""
    return np.split(errors, np.cumsum(np.bincount(pairs.blocks, minlength=count))[:-1])
