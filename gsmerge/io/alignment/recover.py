"""Which row is which pixel, decided by measuring: every layout that the count allows is projected and compared."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmerge.io.alignment.incomplete import score_incomplete
from gsmerge.io.alignment.layouts import Layout, depth_layouts, exact_layouts, plain_layout, subsample
from gsmerge.io.alignment.score import (
    QUICK_SAMPLES,
    SAMPLES,
    AlignmentInput,
    AlignmentScore,
    color_error,
    find_correspondences,
    sample_layout,
    score_layout,
    shuffled_score,
)
from gsmerge.io.alignment.similarity import IDENTITY, candidate_similarities, fits_all_cameras, pixel_errors

MARGIN = 2.0  # by which the best reading must beat the next one
SHUFFLED_MARGIN = 5.0  # and by which it must beat shuffled pixels
COLOR_MARGIN = 1.5  # by which the colours must beat the next reading's and shuffled ones, where pixels do not decide
ENOUGH, FEW = 24, 0.05  # finite rows that decide between readings; fewer will do where they are no such small share
_UNCONFIRMED = 0.9  # of the colours' distance from shuffled pixels: as good as random
_VARIES = 0.01  # mean distance of colours from shuffled pixels below which photos say nothing
_SIMPLER = 1.15  # a simpler frame wins unless it is worse than this factor ...
_SIMPLER_PX = 0.02  # ... and this many pixels
_PLAIN_PX = 0.5  # a file whose rows are the grid as they are is not searched if it is this near to its pixels
_SMALLEST_PX = 1e-3  # distances are compared as if none were smaller, pixels


@dataclass(frozen=True)
class Recovery:
    """The reading that won."""

    best: AlignmentScore
    runner_up: AlignmentScore | None  # the next best; None where the count allows no other
    # how many times nearer the winner's Gaussians are to their pixels than the runner-up's, or than to shuffled pixels
    margin: float
    # how many times farther from the photos the runner-up's colours are, where only that decides between the two; None
    # where the pixels do
    color_margin: float | None = None
    # whether the photos' colours agree with the reading; None where there are no photos, or none that could decide
    confirmed: bool | None = None

    @property
    def description(self) -> str:
        """Which reading won and by how much."""
        other = "shuffled pixels" if self.runner_up is None else self.runner_up.description
        text = f"{self.best.description}: median {self.best.median_px:.2f} px from the pixels, "
        if self.color_margin is None:
            text += f"{min(self.margin, 9999):.0f} times nearer than the next reading ({other})"
        else:
            text += f"and the photos' colours {min(self.color_margin, 9999):.1f} times nearer than under the next"
            text += f" reading ({other}), which fits the pixels as well"
        return text + ("; the photos' colours do not confirm it" if self.confirmed is False else "")


def recover(inputs: AlignmentInput, *, exact_frames: bool = False) -> Recovery | None:
    """The reading under which every Gaussian projects into its own pixel; None where none stands out.

    Of readings that put the Gaussians about equally near to their pixels, the photos' colours choose one. With
    ``exact_frames`` only cameras in the frame of their file and files without missing pixels are considered: quick.
    """
    finite = int(inputs.valid.sum())
    if inputs.order == "none" or (finite < ENOUGH and finite < FEW * len(inputs.gaussians)):
        return None
    inputs = _without_same_labellings(inputs)
    plain = _plain(inputs)
    if plain is not None:
        return plain
    scores: list[AlignmentScore] = []
    layouts = exact_layouts_of(inputs)
    for effort in (0,) if exact_frames else (0, 1, 2):
        if not any(score.ok for score in scores):
            scores += [score for layout in layouts for score in _readings(inputs, layout, effort)]
    if not (exact_frames or any(score.ok for score in scores)):
        scores += score_incomplete(inputs)
    scores.sort(key=lambda score: (not score.ok, score.worst_px))
    if not scores or not scores[0].ok:
        return None
    first, *others = scores
    others = [other for other in others if _differs(other.layout, first.layout)]
    best = _refine(inputs, first)
    close = [other for other in others if other.worst_px < MARGIN * max(best.worst_px, _SMALLEST_PX)]
    if close:
        return _by_colors(inputs, [first, *close])
    runner_up = min(others, key=lambda e: e.worst_px, default=None)
    return _accepted(inputs, best, runner_up)


def _without_same_labellings(inputs: AlignmentInput) -> AlignmentInput:
    """Orders that only exchange views of one pose with equal photos, or without any, are one: either is right."""
    cameras, images, (first, *others) = inputs.cameras, inputs.images, inputs.labellings
    facts = np.concatenate([cameras.viewmats[:, :3].reshape(-1, 12), cameras.Ks.reshape(-1, 9)], 1)

    def same(other: Sequence[int]) -> bool:
        moved = [(a, b) for a, b in zip(first, other, strict=True) if a != b]
        alike = images is None or all(np.array_equal(images[a], images[b]) for a, b in moved)
        return alike and all(np.array_equal(facts[a], facts[b]) for a, b in moved)

    return replace(inputs, labellings=[first, *(first if same(other) else other for other in others)])


def _accepted(inputs: AlignmentInput, best: AlignmentScore, runner_up: AlignmentScore | None) -> Recovery | None:
    """A reading that the pixels alone decide for; None where shuffled pixels are about as near."""
    shuffled_px, shuffled_color = shuffled_score(inputs, best)
    if not _stands_out(best, shuffled_px):
        return None
    next_px = min(shuffled_px, math.inf if runner_up is None else runner_up.worst_px)
    margin = next_px / max(best.worst_px, _SMALLEST_PX)
    return Recovery(best, runner_up, margin, None, _confirmed(inputs, best, shuffled_color))


def _confirmed(inputs: AlignmentInput, best: AlignmentScore, shuffled_color: float) -> bool | None:
    """Whether the photos' colours agree with a reading; None where shuffled pixels look alike, or without photos."""
    if not shuffled_color > _VARIES:
        return None
    return color_error(inputs, best.layout) <= _UNCONFIRMED * shuffled_color


def _plain(inputs: AlignmentInput) -> Recovery | None:
    """The rows as they are, under the cameras as they are; None where that leaves a doubt and others are to be tried.

    Most files are so, and trying the other readings takes longer than reading the file.
    """
    cameras, count = inputs.cameras, len(inputs.gaussians)
    expected = len(cameras) * cameras.width * cameras.height
    if inputs.order not in ("auto", "view-major") or inputs.scale is not None or count != expected:
        return None
    layout = plain_layout(len(cameras), cameras.width, cameras.height)
    best, *others = (
        score_layout(inputs, replace(layout, views=views), IDENTITY)
        for views in dict.fromkeys(map(tuple, inputs.labellings))
    )
    distance = max(best.worst_px, _SMALLEST_PX)
    if best.worst_px > _PLAIN_PX or any(other.worst_px < SHUFFLED_MARGIN * distance for other in others):
        return None
    return _accepted(inputs, best, None)


def _by_colors(inputs: AlignmentInput, close: list[AlignmentScore]) -> Recovery | None:
    """The one of several readings, about equally near to their pixels, whose colours the photos have by far."""
    ranked = sorted((color_error(inputs, score.layout), i) for i, score in enumerate(close))
    (color, first), (next_color, second) = ranked[:2]
    best, runner_up = _refine(inputs, close[first]), close[second]
    shuffled_px, shuffled_color = shuffled_score(inputs, best)
    others = min(next_color, shuffled_color)  # NaN without photos, which no comparison holds for
    if not (_stands_out(best, shuffled_px) and others > _VARIES and others >= COLOR_MARGIN * color):
        return None
    margin = min(shuffled_px, runner_up.worst_px) / max(best.worst_px, _SMALLEST_PX)
    return Recovery(best, runner_up, margin, others / max(color, 1e-3), True)


def _stands_out(best: AlignmentScore, shuffled_px: float) -> bool:
    """Whether a reading is near enough to its pixels, and shuffled pixels are far from them."""
    return best.ok and shuffled_px >= SHUFFLED_MARGIN * max(best.worst_px, _SMALLEST_PX)


def exact_layouts_of(inputs: AlignmentInput) -> list[Layout]:
    """The layouts that the number of rows allows, or the depth maps next to the cameras."""
    cameras, count = inputs.cameras, len(inputs.gaussians)
    layouts = list(exact_layouts(count, len(cameras), cameras.width, cameras.height))
    if count < len(cameras) * cameras.width * cameras.height and inputs.order in ("auto", "view-major"):
        depths = inputs.depths()
        if depths is not None and depths.shape == (len(cameras), cameras.height, cameras.width):
            layouts += depth_layouts(count, depths)
    return [layout for layout in layouts if inputs.order in ("auto", layout.order)]


def _readings(inputs: AlignmentInput, layout: Layout, effort: int) -> list[AlignmentScore]:
    """The layout under the best frame, for each order that the views may be in.

    Any order at all is tried with the most effort, or where the file lacks views.
    """
    out: dict[tuple[int, ...], AlignmentScore] = {}
    labellings = [[labelling[view] for view in layout.views] for labelling in inputs.labellings]
    lacks_views = len(set(layout.views)) < len(inputs.cameras)
    if (lacks_views or effort == 2) and inputs.scale is None:
        labellings.append(_nearest_views(inputs, layout) or [])
    for labelling in labellings:
        views = tuple(labelling)
        if views and views not in out:
            out[views] = _best_frame(inputs, replace(layout, views=views), QUICK_SAMPLES, effort)
    return list(out.values())


def _best_frame(inputs: AlignmentInput, layout: Layout, samples: int, effort: int) -> AlignmentScore:
    pairs = find_correspondences(inputs.gaussians.means, inputs.valid, sample_layout(layout, samples))
    frames = candidate_similarities(
        pairs, inputs.cameras.viewmats, inputs.cameras.Ks, scale=inputs.scale, effort=effort
    )
    scores = [score_layout(inputs, layout, frame, pairs) for frame in frames]
    lowest = min(score.worst_px for score in scores)
    best = next(score for score in scores if score.worst_px <= max(_SIMPLER * lowest, lowest + _SIMPLER_PX))
    if best.ok and best.frame is not IDENTITY and inputs.scale is None:
        return replace(best, ok=fits_all_cameras(best.frame, pairs, inputs.cameras.viewmats, inputs.cameras.Ks))
    return best


def _refine(inputs: AlignmentInput, score: AlignmentScore) -> AlignmentScore:
    """The winner scored again, and its frame solved again, on more Gaussians."""
    if score.layout.kind == "pruned":
        return score
    return _best_frame(inputs, score.layout, SAMPLES, 2 if score.frame.kind == "other" else 1)


def _nearest_views(inputs: AlignmentInput, layout: Layout) -> list[int] | None:
    """For each block the camera into whose pixels it projects best; None where two want the same."""
    pairs = find_correspondences(inputs.gaussians.means, inputs.valid, subsample(layout, 300))
    chosen = []
    for block in range(len(layout.views)):
        own = pairs.select(pairs.blocks == block)
        if not len(own.rows):
            return None
        views = (np.full(len(own.rows), view) for view in range(len(inputs.cameras)))
        errors = [
            np.median(pixel_errors(replace(own, views=some), inputs.cameras.viewmats, inputs.cameras.Ks))
            for some in views
        ]
        chosen.append(int(np.argmin(errors)))
    return chosen if len(set(chosen)) * layout.per_pixel == len(chosen) else None


def _differs(one: Layout, other: Layout) -> bool:
    """Whether two layouts put rows to different pixels, judged by some rows of each block."""
    if one.views != other.views or [r.size for r in one.rows] != [r.size for r in other.rows]:
        return True
    a, b = subsample(one, 200), subsample(other, 200)
    return not all(np.array_equal(x, y) for x, y in zip((*a.rows, *a.pixels), (*b.rows, *b.pixels), strict=True))
