"""Choose among candidate layouts: the one clearly nearest to its pixels, or else the one with the right colours."""

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
    ScoredLayout,
    beats_shuffled,
    color_error,
    is_as_near,
    is_clearly_nearer,
    score_shuffled,
)
from gsmerge.errors import SceneError

# Least colour error of the next candidate and of shuffled pixels, divided by the colour error of the best candidate
COLOR_MARGIN = 1.5
_COMPARED_ROWS = 200  # rows of each part that are compared to find out whether two layouts differ
_WRONG_SIZE_PX = 0.3  # a grid of a wrong size has a larger median distance at every scale


@dataclass(frozen=True)
class Candidate:
    """A layout of the rows in a grid of some size, with its score."""

    grid: Grid
    scored: ScoredLayout

    @property
    def px(self) -> float:
        """Median distance of the Gaussians from their pixels in the worst view, pixels."""
        return self.scored.alignment.worst_px

    @property
    def is_doubtful(self) -> bool:
        """True if a grid of another size may fit as well, because borders are cut off and the scale is solved for."""
        return self.scored.layout.kind == "trim" and self.scored.frame.scale != 1 and self.px > _WRONG_SIZE_PX


@dataclass(frozen=True)
class Recovery:
    """The chosen layout of the rows, and how clearly it is the right one."""

    chosen: Candidate
    margin: float  # distance of the Gaussians from shuffled pixels, divided by their distance from their own pixels
    other: ScoredLayout | None = None  # another layout that fits the pixels as well; None if the pixels decided
    color_margin: float | None = None  # colour error of the other layout, divided by the chosen layout's
    # True if the photos' colours agree with the layout, False if they do not, None without photos that could decide
    confirmed: bool | None = None

    @property
    def best(self) -> ScoredLayout:
        """The chosen layout."""
        return self.chosen.scored

    @property
    def description(self) -> str:
        """Description of the layout and its margin in words."""
        text = f"{self.best.description}: median {self.best.alignment.middle_px:.2f} px from the pixels, "
        if self.other is None or self.color_margin is None:
            text += f"{min(self.margin, 9999):.0f} times nearer than shuffled pixels"
        else:
            text += f"and the photos' colours {min(self.color_margin, 9999):.1f} times nearer than in the next layout"
            text += f" ({self.other.description}), which fits the pixels as well"
        return text + ("; the photos' colours do not confirm it" if self.confirmed is False else "")


def judge(
    candidates: Sequence[Candidate], read: Callable[[Grid], AlignmentInput], rescore: Callable[[Candidate], Candidate]
) -> Recovery | None:
    """Choose the candidate that is nearest to its pixels; among equally near candidates the photos' colours decide.

    Only candidates with the least effort count, see :class:`ScoredLayout`. ``read`` reads the photos of a grid, and
    ``rescore`` scores a candidate on more Gaussians. None if no candidate stands out; SceneError if poses fit in
    several conventions.
    """
    effort = min((candidate.scored.effort for candidate in candidates), default=0)
    by_distance = sorted((c for c in candidates if c.scored.effort == effort), key=lambda candidate: candidate.px)
    nearest = by_distance[0]
    tied = [candidate for candidate in by_distance if not is_clearly_nearer(nearest.px, candidate.px)]
    _check_one_convention(tied)
    if nearest.scored.layout.kind == "pruned":  # rows that lack pixels also fit into grids of nearly the same size
        tied = [candidate for candidate in tied if candidate.grid.size == nearest.grid.size]
    colors = [color_error(read(c.grid), c.scored.layout) for c in tied] if len(tied) > 1 else [math.nan]
    by_color = sorted(range(len(tied)), key=lambda i: (colors[i], i))
    different = [i for i in by_color if _differs(tied[i].scored.layout, tied[by_color[0]].scored.layout)]
    if not different:  # the same layout, but photos resized by several transforms
        as_near = [i for i in by_color if is_as_near(tied[i].px, nearest.px)]
        return _accept(rescore(tied[as_near[0]]), read)
    best, other = rescore(tied[by_color[0]]), tied[different[0]].scored
    inputs = read(best.grid)
    shuffled_px, shuffled_color = score_shuffled(inputs, best.scored)
    color, next_color = colors[by_color[0]], min(colors[different[0]], shuffled_color)
    colors_decide = next_color > SAME_COLORS and next_color >= COLOR_MARGIN * color  # False if colours are NaN
    if not (colors_decide and beats_shuffled(best.scored, shuffled_px)):
        return None
    margin = shuffled_px / max(best.px, AS_NEAR_PX)
    return Recovery(best, margin, other, next_color / max(color, 1e-3), True)


def _check_one_convention(candidates: Sequence[Candidate]) -> None:
    """Raise SceneError if candidates read the poses in several conventions."""
    conventions = list(dict.fromkeys(candidate.grid.camera_file.convention for candidate in candidates))
    if len(conventions) > 1:
        both = " and as ".join(map(describe_convention, conventions[:2]))
        problem = f"expected poses that fit in one convention, found that they fit as {both}"
        raise SceneError(candidates[0].grid.camera_file.path, problem, "convert them to the convention of the format")


def _accept(candidate: Candidate, read: Callable[[Grid], AlignmentInput]) -> Recovery | None:
    """Accept the only candidate if it is much nearer to its pixels than to shuffled pixels; None if it is not."""
    inputs = read(candidate.grid)
    shuffled_px, shuffled_color = score_shuffled(inputs, candidate.scored)
    if not beats_shuffled(candidate.scored, shuffled_px):
        return None
    confirmed = None  # unknown if colours hardly vary, or without photos
    if shuffled_color > SAME_COLORS:
        confirmed = color_error(inputs, candidate.scored.layout) <= RANDOM_SHARE * shuffled_color
    return Recovery(candidate, shuffled_px / max(candidate.px, AS_NEAR_PX), confirmed=confirmed)


def _differs(layout: Layout, other: Layout) -> bool:
    """Return True if two layouts assign rows to different pixels; only a sample of rows of each part is compared."""
    if (layout.width, layout.height, layout.views) != (other.width, other.height, other.views):
        return True
    if [part_rows.size for part_rows in layout.rows] != [part_rows.size for part_rows in other.rows]:
        return True
    sample, other_sample = subsample(layout, _COMPARED_ROWS), subsample(other, _COMPARED_ROWS)
    arrays, other_arrays = (*sample.rows, *sample.pixels), (*other_sample.rows, *other_sample.pixels)
    return not all(map(np.array_equal, arrays, other_arrays))
