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

COLOR_MARGIN = 1.5  # least ratio of colour errors, of the next candidate and of shuffled pixels, over that of the best
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
    # distance of the Gaussians from shuffled pixels over the distance from their own pixels
    margin: float
    other: ScoredLayout | None = None  # another layout that fits the pixels as well; None if the pixels decided
    color_margin: float | None = None  # colour error of the other layout over that of the chosen one
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
    """Choose the candidate nearest to its pixels, or of equally near ones the one with the right colours.

    Only candidates with the least effort count, see :class:`ScoredLayout`. ``read`` reads the photos of a grid, and
    ``rescore`` scores a candidate on more Gaussians. None if no candidate stands out; SceneError if poses fit in
    several conventions.
    """
    effort = min((each.scored.effort for each in candidates), default=0)
    first, *_ = ranked = sorted((each for each in candidates if each.scored.effort == effort), key=lambda each: each.px)
    near = [each for each in ranked if not is_clearly_nearer(first.px, each.px)]
    conventions = list(dict.fromkeys(each.grid.camera_file.convention for each in near))
    if len(conventions) > 1:
        both = " and as ".join(map(describe_convention, conventions[:2]))
        problem = f"expected poses that fit in one convention, found that they fit as {both}"
        raise SceneError(first.grid.camera_file.path, problem, "convert them to the convention of the format")
    if first.scored.layout.kind == "pruned":  # rows that lack pixels also fit into grids of nearly the same size
        near = [each for each in near if each.grid.size == first.grid.size]
    colors = [color_error(read(each.grid), each.scored.layout) for each in near] if len(near) > 1 else [math.nan]
    order = sorted(range(len(near)), key=lambda i: (colors[i], i))
    different = [i for i in order if _differs(near[i].scored.layout, near[order[0]].scored.layout)]
    if not different:  # the same layout, but photos resized by several transforms
        equal = [i for i in order if is_as_near(near[i].px, first.px)]
        return _accept(rescore(near[equal[0]]), read)
    best, other = rescore(near[order[0]]), near[different[0]].scored
    inputs = read(best.grid)
    shuffled_px, shuffled_color = score_shuffled(inputs, best.scored)
    color, next_color = colors[order[0]], min(colors[different[0]], shuffled_color)
    colors_decide = next_color > SAME_COLORS and next_color >= COLOR_MARGIN * color  # False without photos: NaN
    if not (colors_decide and beats_shuffled(best.scored, shuffled_px)):
        return None
    margin = shuffled_px / max(best.px, AS_NEAR_PX)
    return Recovery(best, margin, other, next_color / max(color, 1e-3), True)


def _accept(candidate: Candidate, read: Callable[[Grid], AlignmentInput]) -> Recovery | None:
    """Accept the only candidate if it is much nearer to its pixels than to shuffled ones; None if it is not."""
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
    if [r.size for r in layout.rows] != [r.size for r in other.rows]:
        return True
    a, b = subsample(layout, 200), subsample(other, 200)
    return not all(np.array_equal(x, y) for x, y in zip((*a.rows, *a.pixels), (*b.rows, *b.pixels), strict=True))
