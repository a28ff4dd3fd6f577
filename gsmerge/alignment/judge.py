"""Judge readings: accept the one of a grid that stands out, and choose between grids that rows fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gsmerge.alignment.cameras import describe_convention
from gsmerge.alignment.layouts import GridFit, Layout, subsample
from gsmerge.alignment.readings import best_frame
from gsmerge.alignment.score import (
    MARGIN,
    SAMPLES,
    SMALLEST_PX,
    AlignmentInput,
    Reading,
    beats_shuffled,
    color_error,
    score_shuffled,
)
from gsmerge.errors import SceneError

COLOR_MARGIN = 1.5  # by which the colours must beat the next reading's and shuffled ones, where pixels do not decide
_RANDOM_SHARE = 0.9  # of the colours' distance from shuffled pixels: as good as random
_MIN_SHUFFLED_COLOR = 0.01  # mean distance of colours from shuffled pixels below which photos say nothing
_SAME, _SAME_PX = 1.15, 0.02  # two fits of one grid between which only the photos' colours can decide
_WRONG_SIZE_PX = 0.3  # median distance that a grid of a wrong size does not reach at any scale


@dataclass(frozen=True)
class Recovery:
    """The best reading of the rows, and how clearly it beats the next best."""

    best: Reading
    runner_up: Reading | None  # the next best; None where the count allows no other
    # how many times nearer the winner's Gaussians are to their pixels than the runner-up's, or than to shuffled pixels
    margin: float
    # how many times farther from the photos the runner-up's colours are, where only that decides between the two; None
    # where the pixels do
    color_margin: float | None = None
    # whether the photos' colours agree with the reading; None where there are no photos, or none that could decide
    confirmed: bool | None = None

    @property
    def description(self) -> str:
        """Description of the reading and its margin in words."""
        other = "shuffled pixels" if self.runner_up is None else self.runner_up.description
        text = f"{self.best.description}: median {self.best.median_px:.2f} px from the pixels, "
        if self.color_margin is None:
            text += f"{min(self.margin, 9999):.0f} times nearer than the next reading ({other})"
        else:
            text += f"and the photos' colours {min(self.color_margin, 9999):.1f} times nearer than under the next"
            text += f" reading ({other}), which fits the pixels as well"
        return text + ("; the photos' colours do not confirm it" if self.confirmed is False else "")


def accept_reading(inputs: AlignmentInput, readings: Sequence[Reading]) -> Recovery | None:
    """Accept the reading that is clearly the nearest to its pixels; None if none stands out.

    Among readings about as near, the one with by far the best colours is accepted.
    """
    if not readings:
        return None
    first, *others = sorted(readings, key=lambda reading: (not reading.ok, reading.worst_px))
    others = [other for other in others if _differs(other.layout, first.layout)]
    best, runner_up = _refine(inputs, first), min(others, key=lambda other: other.worst_px, default=None)
    close = [other for other in others if other.worst_px < MARGIN * max(best.worst_px, SMALLEST_PX)]
    if close:
        close = [first, *close]
        colors = [color_error(inputs, reading.layout) for reading in close]
        chosen, second = sorted(range(len(close)), key=lambda i: (colors[i], i))[:2]
        best, runner_up = _refine(inputs, close[chosen]), close[second]
    shuffled_px, shuffled_color = score_shuffled(inputs, best)
    px = max(best.worst_px, SMALLEST_PX)
    if not beats_shuffled(best, shuffled_px):
        return None
    margin = min(shuffled_px, math.inf if runner_up is None else runner_up.worst_px) / px
    if not close:
        confirmed = None  # where colours hardly vary, or there are no photos
        if shuffled_color > _MIN_SHUFFLED_COLOR:
            confirmed = color_error(inputs, best.layout) <= _RANDOM_SHARE * shuffled_color
        return Recovery(best, runner_up, margin, None, confirmed)
    color, next_color = colors[chosen], min(colors[second], shuffled_color)  # NaN without photos: nothing is accepted
    if not (next_color > _MIN_SHUFFLED_COLOR and next_color >= COLOR_MARGIN * color):
        return None
    return Recovery(best, runner_up, margin, next_color / max(color, 1e-3), True)


@dataclass(frozen=True)
class Fit:
    """A grid whose pixels are the rows."""

    grid: GridFit
    recovery: Recovery

    @property
    def px(self) -> float:
        """Median distance of the Gaussians from their pixels in the worst view, pixels."""
        return self.recovery.best.worst_px

    @property
    def is_doubtful(self) -> bool:
        """Whether a grid of another size may fit as well, since borders are cut off and the scale is solved for."""
        best = self.recovery.best
        return best.layout.kind == "trim" and best.frame.scale != 1 and self.px > _WRONG_SIZE_PX


def choose_fit(fits: Sequence[Fit], read: Callable[[GridFit], AlignmentInput]) -> Fit | None:
    """Choose the fit that is nearest to its pixels, or among similar fits the one whose photos have the right colours.

    ``read`` resizes the photos to a grid. None where a grid of another size is about as near and no photos decide;
    SceneError where poses in another convention are.
    """
    best = min(fits, key=lambda fit: fit.px, default=None)
    if best is None:
        return None
    rivals = sorted((fit for fit in fits if fit.px < MARGIN * max(best.px, SMALLEST_PX)), key=lambda fit: fit.px)
    conventions = list(dict.fromkeys(fit.grid.camera_file.convention for fit in rivals))
    if len(conventions) > 1:
        both = " and as ".join(map(describe_convention, conventions[:2]))
        problem = f"expected poses that fit in one reading, found that they fit as {both}"
        raise SceneError(best.grid.camera_file.path, problem, "convert them to the format's own")
    exact = best.recovery.best.layout.kind != "pruned"  # what lacks pixels fits into grids of nearly its size as well
    if exact and any(fit.grid.size != best.grid.size for fit in rivals):
        colors = [color_error(read(fit.grid), fit.recovery.best.layout) for fit in rivals]  # NaN without photos
        best = rivals[int(np.argmin(colors))]
        others = [color for fit, color in zip(rivals, colors, strict=True) if fit.grid.size != best.grid.size]
        if not min(others) >= COLOR_MARGIN * min(colors):
            return None
    near = max(_SAME * best.px, best.px + _SAME_PX)
    same = (fit for fit in fits if fit.grid.camera_file is best.grid.camera_file and fit.grid.size == best.grid.size)
    same_px = [fit for fit in same if fit.px <= near]
    if len(same_px) == 1:
        return best
    errors = [color_error(read(fit.grid), fit.recovery.best.layout) for fit in same_px]
    return same_px[int(np.argmin(np.nan_to_num(errors, nan=1.0)))]


def _refine(inputs: AlignmentInput, reading: Reading) -> Reading:
    """Score a reading again, with its frame solved again on more Gaussians if there were few."""
    effort = 2 if reading.frame.kind == "other" else 1
    return best_frame(inputs, reading.layout, SAMPLES, effort) if reading.quick else reading


def _differs(layout: Layout, other: Layout) -> bool:
    """Return whether two layouts put rows to different pixels, judged by some rows of each part."""
    if layout.views != other.views or [r.size for r in layout.rows] != [r.size for r in other.rows]:
        return True
    a, b = subsample(layout, 200), subsample(other, 200)
    return not all(np.array_equal(x, y) for x, y in zip((*a.rows, *a.pixels), (*b.rows, *b.pixels), strict=True))
