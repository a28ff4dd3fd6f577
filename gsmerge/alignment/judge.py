"""Judge readings of rows: take the one that stands out by its pixels, or else by the photos' colours."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gsmerge.alignment.cameras import describe_convention
from gsmerge.alignment.grids import Grid
from gsmerge.alignment.layouts import Layout, subsample
from gsmerge.alignment.score import (
    AS_NEAR_PX,
    RANDOM_SHARE,
    SAME_COLORS,
    AlignmentInput,
    Reading,
    beats_shuffled,
    color_error,
    is_as_near,
    is_clearly_nearer,
    score_shuffled,
)
from gsmerge.errors import SceneError

COLOR_MARGIN = 1.5  # by which the colours must beat the next reading's and shuffled ones, where pixels do not decide
_WRONG_SIZE_PX = 0.3  # median distance that a grid of a wrong size does not reach at any scale


@dataclass(frozen=True)
class GridReading:
    """A reading of the rows in a grid of some size."""

    grid: Grid
    reading: Reading

    @property
    def px(self) -> float:
        """Median distance of the Gaussians from their pixels in the worst view, pixels."""
        return self.reading.alignment.worst_px

    @property
    def is_doubtful(self) -> bool:
        """Whether a grid of another size may fit as well, since borders are cut off and the scale is solved for."""
        return self.reading.layout.kind == "trim" and self.reading.frame.scale != 1 and self.px > _WRONG_SIZE_PX


@dataclass(frozen=True)
class Recovery:
    """The reading of the rows that was taken, and how clearly it is the right one."""

    chosen: GridReading
    # how many times nearer the Gaussians are to their pixels than to shuffled pixels
    margin: float
    other: Reading | None = None  # another one that fits the pixels as well, against which the photos' colours decided
    color_margin: float | None = None  # how many times farther its colours are from the photos
    # whether the photos' colours agree with the reading; None where there are no photos, or none that could decide
    confirmed: bool | None = None

    @property
    def best(self) -> Reading:
        """The reading of the rows."""
        return self.chosen.reading

    @property
    def description(self) -> str:
        """Description of the reading and its margin in words."""
        text = f"{self.best.description}: median {self.best.alignment.middle_px:.2f} px from the pixels, "
        if self.other is None or self.color_margin is None:
            text += f"{min(self.margin, 9999):.0f} times nearer than shuffled pixels"
        else:
            text += f"and the photos' colours {min(self.color_margin, 9999):.1f} times nearer than under the next"
            text += f" reading ({self.other.description}), which fits the pixels as well"
        return text + ("; the photos' colours do not confirm it" if self.confirmed is False else "")


def judge(
    candidates: Sequence[GridReading],
    read: Callable[[Grid], AlignmentInput],
    refine: Callable[[GridReading], GridReading],
) -> Recovery | None:
    """Take the candidate nearest to its pixels, or the one of similar ones whose photos have the right colours.

    ``read`` reads the photos of a grid, and ``refine`` scores one on more Gaussians. Frames that need less solving
    come first. None if none stands out; SceneError where poses fit in several conventions.
    """
    effort = min((each.reading.effort for each in candidates), default=0)
    first, *_ = ranked = sorted(
        (each for each in candidates if each.reading.effort == effort), key=lambda each: each.px
    )
    near = [each for each in ranked if not is_clearly_nearer(first.px, each.px)]
    conventions = list(dict.fromkeys(each.grid.camera_file.convention for each in near))
    if len(conventions) > 1:
        both = " and as ".join(map(describe_convention, conventions[:2]))
        problem = f"expected poses that fit in one reading, found that they fit as {both}"
        raise SceneError(first.grid.camera_file.path, problem, "convert them to the format's own")
    if first.reading.layout.kind == "pruned":  # what lacks pixels fits into grids of nearly its size as well
        near = [each for each in near if each.grid.size == first.grid.size]
    colors = [color_error(read(each.grid), each.reading.layout) for each in near] if len(near) > 1 else [math.nan]
    order = sorted(range(len(near)), key=lambda i: (colors[i], i))
    others = [i for i in order if _differs(near[i].reading.layout, near[order[0]].reading.layout)]
    if not others:  # of photos that were resized in several ways
        same = [i for i in order if is_as_near(near[i].px, first.px)]
        return _accept(refine(near[same[0]]), read)
    best, other = refine(near[order[0]]), near[others[0]].reading
    inputs = read(best.grid)
    shuffled_px, shuffled_color = score_shuffled(inputs, best.reading)
    color, next_color = colors[order[0]], min(colors[others[0]], shuffled_color)
    decided = next_color > SAME_COLORS and next_color >= COLOR_MARGIN * color  # not without photos: NaN
    if not (decided and beats_shuffled(best.reading, shuffled_px)):
        return None
    margin = shuffled_px / max(best.px, AS_NEAR_PX)
    return Recovery(best, margin, other, next_color / max(color, 1e-3), True)


def _accept(candidate: GridReading, read: Callable[[Grid], AlignmentInput]) -> Recovery | None:
    """Accept a candidate that has no others if its pixels beat shuffled ones; None if they do not."""
    inputs = read(candidate.grid)
    shuffled_px, shuffled_color = score_shuffled(inputs, candidate.reading)
    if not beats_shuffled(candidate.reading, shuffled_px):
        return None
    confirmed = None  # where colours hardly vary, or there are no photos
    if shuffled_color > SAME_COLORS:
        confirmed = color_error(inputs, candidate.reading.layout) <= RANDOM_SHARE * shuffled_color
    return Recovery(candidate, shuffled_px / max(candidate.px, AS_NEAR_PX), confirmed=confirmed)


def _differs(layout: Layout, other: Layout) -> bool:
    """Return whether two layouts put rows to different pixels, judged by some rows of each part."""
    if (layout.width, layout.height, layout.views) != (other.width, other.height, other.views):
        return True
    if [r.size for r in layout.rows] != [r.size for r in other.rows]:
        return True
    a, b = subsample(layout, 200), subsample(other, 200)
    return not all(np.array_equal(x, y) for x, y in zip((*a.rows, *a.pixels), (*b.rows, *b.pixels), strict=True))
