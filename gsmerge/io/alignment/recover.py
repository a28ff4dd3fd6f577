"""Which row is which pixel, decided by measuring: every layout that the count allows is projected and compared."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from gsmerge.io.alignment.dropped import dropped_readings
from gsmerge.io.alignment.layouts import Layout, depth_layout, exact_layouts, relabelled, thinned
from gsmerge.io.alignment.score import (
    QUICK_SAMPLES,
    SAMPLES,
    Clues,
    Evidence,
    color_error,
    dealt_out,
    measured,
    sampled,
    sightings,
)
from gsmerge.io.alignment.similarity import SAME, Sightings, candidate_frames, explains, pixel_errors

MARGIN = 2.0  # by which the best reading must beat the next one
SHUFFLED_MARGIN = 5.0  # and by which it must beat pixels dealt out at random
COLOR_MARGIN = 1.5  # by which the colours must beat the next reading's and random ones, where pixels do not decide
ENOUGH, FEW = 24, 0.05  # finite rows that a reading can be told from; less will do where they are no such small share
_UNCONFIRMED = 0.9  # of the colours' distance from random pixels: as good as random
_VARIES = 0.01  # mean distance of colours from random pixels below which photos say nothing
_SIMPLER = 1.15  # a simpler frame wins unless it is worse than this factor ...
_SIMPLER_PX = 0.02  # ... and this many pixels


@dataclass(frozen=True)
class Recovery:
    """The reading that won.

    Args:
        best: The winner.
        runner_up: The next best; None where the count allows no other.
        margin: How many times nearer the winner's Gaussians are to their pixels than the runner-up's, or than
            those of pixels dealt out at random.
        color_margin: How many times farther from the photos the runner-up's colours are, where only that tells the
            two apart; None where the pixels do.
        confirmed: Whether the photos' colours agree with the reading; None where there are no photos, or none that
            could tell.
    """

    best: Evidence
    runner_up: Evidence | None
    margin: float
    color_margin: float | None = None
    confirmed: bool | None = None

    @property
    def words(self) -> str:
        """Which reading won and by how much."""
        other = "pixels dealt out at random" if self.runner_up is None else self.runner_up.words
        said = f"{self.best.words}: median {self.best.median_px:.2f} px from the pixels, "
        if self.color_margin is None:
            said += f"{min(self.margin, 9999):.0f} times nearer than the next reading ({other})"
        else:
            said += (
                f"and the photos' colours {min(self.color_margin, 9999):.1f} times nearer than under the next reading"
                f" ({other}), which fits the pixels as well"
            )
        return said + ("; the photos' colours do not confirm it" if self.confirmed is False else "")


def recover(clues: Clues, *, exact_frames: bool = False) -> Recovery | None:
    """The reading under which every Gaussian projects into its own pixel; None where none stands out.

    Readings that put the Gaussians about equally near to their pixels are told apart by the photos' colours.

    Args:
        clues: What there is.
        exact_frames: Only look where the cameras stand where their file has them and no pixel is missing: quick.
    """
    if clues.order == "none" or _says_nothing(clues):
        return None
    layouts = list(_exact(clues))
    found: list[Evidence] = []
    for effort in (0,) if exact_frames else (0, 1, 2):
        if not any(evidence.ok for evidence in found):
            found += [evidence for layout in layouts for evidence in _readings(clues, layout, effort)]
    if not (exact_frames or any(evidence.ok for evidence in found)):
        found += dropped_readings(clues)
    found.sort(key=lambda evidence: (not evidence.ok, evidence.worst_px))
    if not found or not found[0].ok:
        return None
    found = [found[0], *(e for e in found[1:] if _differs(e.layout, found[0].layout))]
    best = _refined(clues, found[0])
    rivals = [e for e in found[1:] if e.worst_px < MARGIN * max(best.worst_px, 1e-3)]
    if rivals:
        return _by_colors(clues, [found[0], *rivals])
    runner_up = min(found[1:], key=lambda e: e.worst_px, default=None)
    shuffled_px, shuffled_color = dealt_out(clues, best)
    margin = min(shuffled_px, math.inf if runner_up is None else runner_up.worst_px) / max(best.worst_px, 1e-3)
    if not _stands_out(best, shuffled_px):
        return None
    return Recovery(best, runner_up, margin, None, _confirmed(color_error(clues, best.layout), shuffled_color))


def _says_nothing(clues: Clues) -> bool:
    """Whether so few of many rows are finite that any reading would do."""
    finite = int(clues.valid.sum())
    return finite < ENOUGH and finite < FEW * len(clues.gaussians)


def _by_colors(clues: Clues, rivals: list[Evidence]) -> Recovery | None:
    """The one of several readings, about equally near to their pixels, whose colours the photos have by far."""
    ranked = sorted((color_error(clues, rival.layout), i) for i, rival in enumerate(rivals))
    (color, first), (next_color, second) = ranked[:2]
    best, runner_up = _refined(clues, rivals[first]), rivals[second]
    shuffled_px, shuffled_color = dealt_out(clues, best)
    others = min(next_color, shuffled_color)  # NaN without photos, which no comparison holds for
    if not (_stands_out(best, shuffled_px) and others > _VARIES and others >= COLOR_MARGIN * color):
        return None
    margin = min(shuffled_px, runner_up.worst_px) / max(best.worst_px, 1e-3)
    return Recovery(best, runner_up, margin, others / max(color, 1e-3), True)


def _stands_out(best: Evidence, shuffled_px: float) -> bool:
    """Whether a reading is near enough to its pixels, and those dealt out at random are far from them."""
    return best.ok and shuffled_px >= SHUFFLED_MARGIN * max(best.worst_px, 1e-3)


def _confirmed(color: float, shuffled: float) -> bool | None:
    """Whether the colours are nearer to the photos than to pixels dealt out at random; None where nobody can tell."""
    return color <= _UNCONFIRMED * shuffled if shuffled > _VARIES else None


def _exact(clues: Clues) -> Iterator[Layout]:
    cameras, count = clues.cameras, len(clues.gaussians)
    for layout in exact_layouts(count, len(cameras), cameras.width, cameras.height):
        if clues.order in ("auto", layout.order):
            yield layout
    if count < len(cameras) * cameras.width * cameras.height and clues.order in ("auto", "view-major"):
        depths = clues.depths()
        if depths is not None and depths.shape == (len(cameras), cameras.height, cameras.width):
            masked = depth_layout(count, depths)
            if masked is not None:
                yield masked


def _readings(clues: Clues, layout: Layout, effort: int) -> list[Evidence]:
    """The layout under the best frame, for each order that the views may be in.

    Any order at all is tried with the most effort, or where the file lacks views.
    """
    out: dict[tuple[int, ...], Evidence] = {}
    labellings = [[labelling[view] for view in layout.views] for labelling in clues.labellings]
    some = len(set(layout.views)) < len(clues.cameras)
    if (some or effort == 2) and clues.scale is None:
        labellings.append(_nearest_views(clues, layout) or [])
    for views in labellings:
        if views and tuple(views) not in out:
            out[tuple(views)] = _best_frame(clues, relabelled(layout, views), QUICK_SAMPLES, effort)
    return list(out.values())


def _best_frame(clues: Clues, layout: Layout, samples: int, effort: int) -> Evidence:
    sight = sightings(clues, sampled(layout, samples))
    seen = sight[0]
    frames = candidate_frames(seen, clues.viewmats, clues.Ks, scale=clues.scale, effort=effort)
    tried = [measured(clues, layout, frame, sight) for frame in frames]
    best = min(e.worst_px for e in tried)
    found = next(e for e in tried if e.worst_px <= max(_SIMPLER * best, best + _SIMPLER_PX))
    if found.ok and found.frame is not SAME and clues.scale is None:
        return replace(found, ok=explains(found.frame, seen, clues.viewmats, clues.Ks))
    return found


def _refined(clues: Clues, found: Evidence) -> Evidence:
    """The winner measured again, and its frame solved again, on more Gaussians."""
    if found.layout.kind == "pruned":
        return found
    return _best_frame(clues, found.layout, SAMPLES, 2 if found.frame.kind == "other" else 1)


def _nearest_views(clues: Clues, layout: Layout) -> list[int] | None:
    """For each block the camera into whose pixels it projects best; None where two want the same."""
    small = thinned(layout, 300)
    seen, _ = sightings(clues, replace(small, views=tuple(range(len(small.views)))), colored=False)
    viewmats, Ks = clues.viewmats, clues.Ks
    chosen = []
    for block in range(len(small.views)):
        mine = seen.blocks == block
        if not mine.any():
            return None
        some = Sightings(seen.points[mine], seen.pixels[mine], seen.views[mine], seen.blocks[mine])
        errors = [
            np.median(pixel_errors(replace(some, views=np.full(int(mine.sum()), view)), viewmats, Ks))
            for view in range(len(viewmats))
        ]
        chosen.append(int(np.argmin(errors)))
    distinct = len(set(chosen)) * layout.per_pixel == len(chosen)
    return chosen if distinct else None


def _differs(one: Layout, other: Layout) -> bool:
    """Whether two layouts put rows to different pixels; looked at in some rows of each block."""
    if one.views != other.views or [r.size for r in one.rows] != [r.size for r in other.rows]:
        return True
    a, b = thinned(one, 200), thinned(other, 200)
    return not all(np.array_equal(x, y) for x, y in zip((*a.rows, *a.pixels), (*b.rows, *b.pixels), strict=True))
