"""How well a reading of a file fits: where its Gaussians project to, and which colours the photos have there."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from gsmerge.io.alignment.layouts import Layout, thinned
from gsmerge.io.alignment.similarity import Frame, Sightings, pixel_errors
from gsmerge.io.alignment.verify import pixel_limit
from gsmerge.types import SH_C0, Cameras, Gaussians

QUICK_SAMPLES, SAMPLES, MIN_SAMPLES = 1500, 6000, 60  # Gaussians that a reading is measured on; per view at least


@dataclass(frozen=True)
class Evidence:
    """One reading of a file, measured.

    Args:
        layout: Which row belongs to which pixel.
        frame: Where the cameras stand in the frame of the Gaussians.
        median_px: Median distance of the projected Gaussians from their pixels; inf where most are behind.
        worst_px: The same of the worst view.
        color_error: Mean distance of the base colours from the photos, 0 to 1; NaN without photos.
        ok: Whether it is near enough to be true.
    """

    layout: Layout
    frame: Frame
    median_px: float
    worst_px: float
    color_error: float
    ok: bool

    @property
    def words(self) -> str:
        """What it is, for people."""
        return ", ".join(part for part in (self.layout.words, self.frame.words) if part)


@dataclass(frozen=True)
class Clues:
    """What there is to recover the pixels from.

    Args:
        gaussians: The file's rows.
        valid: ``[n]`` bool.
        cameras: All cameras at the grid's size, in their own world.
        images: ``[c,h,w,3]``, or None.
        labellings: Orders that the views may be in: the file's, that of the names.
        depths: Reads ``[c,h,w]`` depth maps beside the cameras; None where there are none.
        order: The order of the rows where it is told, otherwise "auto".
        scale: Size of the Gaussians' world in units of the cameras', where it is told.
    """

    gaussians: Gaussians
    valid: Tensor
    cameras: Cameras
    images: Tensor | None
    labellings: Sequence[Sequence[int]]
    depths: Callable[[], np.ndarray | None]
    order: str = "auto"
    scale: float | None = None

    @property
    def viewmats(self) -> np.ndarray:
        """``[c,4,4]`` float64."""
        return np.asarray(self.cameras.viewmats.double().numpy())

    @property
    def Ks(self) -> np.ndarray:  # noqa: N802 - the field's name
        """``[c,3,3]`` float64."""
        return np.asarray(self.cameras.Ks.double().numpy())


def sampled(layout: Layout, samples: int = SAMPLES) -> Layout:
    """As much of a layout as its reading is measured on."""
    return thinned(layout, max(MIN_SAMPLES, samples // len(layout.views)))


def sightings(clues: Clues, layout: Layout, *, colored: bool = True) -> tuple[Sightings, np.ndarray | None]:
    """The rows of a layout with their pixels and views, and how far their colours are from the photos."""
    rows, pixels = np.concatenate(layout.rows), np.concatenate(layout.pixels)
    blocks = np.repeat(np.arange(len(layout.views)), [len(some) for some in layout.rows])
    good = clues.valid.numpy()[rows]
    rows, pixels, blocks = rows[good], pixels[good], blocks[good]
    views = np.array(layout.views)[blocks]
    y, x = np.divmod(pixels, layout.width)
    points = clues.gaussians.means.numpy()[rows].astype(np.float64)
    colors = None
    if colored and clues.images is not None:
        base = 0.5 + SH_C0 * clues.gaussians.sh0.numpy()[rows, 0]
        colors = np.abs(base.clip(0, 1) - clues.images.numpy()[views, y, x]).mean(1)
    return Sightings(points, np.stack([x, y], 1) + 0.5, views, blocks), colors


def color_error(clues: Clues, layout: Layout) -> float:
    """Mean distance of the base colours from the photos at a layout's pixels, 0 to 1; NaN without photos."""
    return _mean(sightings(clues, sampled(layout))[1])


def measured(
    clues: Clues, layout: Layout, frame: Frame, sight: tuple[Sightings, np.ndarray | None] | None = None
) -> Evidence:
    """A layout in a frame, measured on some of its rows: those of ``sight``, where they are at hand."""
    seen, colors = sightings(clues, sampled(layout)) if sight is None else sight
    errors = pixel_errors(seen, frame.move_cameras(clues.viewmats), clues.Ks)
    bounds = np.concatenate([[0], np.cumsum(np.bincount(seen.blocks, minlength=len(layout.views)))])
    medians = [float(np.median(errors[a:b])) for a, b in itertools.pairwise(bounds) if b > a]
    median = float(np.median(errors)) if len(errors) else math.inf
    limit = pixel_limit(layout.width, layout.height)
    ok = bool(medians) and max(medians) < limit and bool(np.isfinite(errors).mean() > 0.5)
    return Evidence(layout, frame, median, max(medians, default=math.inf), _mean(colors), ok)


def dealt_out(clues: Clues, best: Evidence) -> tuple[float, float]:
    """Median distance in pixels, and mean distance of the colours, if a reading's pixels were dealt out at random.

    They are dealt out within each block.
    """
    rng, some = np.random.default_rng(0), sampled(best.layout)
    seen, colors = sightings(clues, replace(some, pixels=tuple(rng.permutation(pixels) for pixels in some.pixels)))
    errors = pixel_errors(seen, best.frame.move_cameras(clues.viewmats), clues.Ks)
    return float(np.median(errors)), _mean(colors)


def _mean(colors: np.ndarray | None) -> float:
    return math.nan if colors is None or not len(colors) else float(colors.mean())
