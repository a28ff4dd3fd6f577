"""Readings of files that lack pixels, nobody knows which, or have them in no order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from gsmerge.io.alignment.interleaved import interleaved_layout
from gsmerge.io.alignment.layouts import Layout
from gsmerge.io.alignment.pruned import finer_scale, pruned_layout, rough_scale, scaled
from gsmerge.io.alignment.score import Clues, Evidence, measured, sampled, sightings
from gsmerge.io.alignment.similarity import SAME, Frame, Sightings, candidate_frames
from gsmerge.io.alignment.unordered import unordered_layout
from gsmerge.types import SH_C0

_ROUNDS = 3  # of a layout and the scale that follows from it
_SURELY_PX = 0.3  # median distance that finding pixels does not bring about in a wrong frame
_AS_GOOD = 1.05  # of that distance: no worse, where the scale is solved from more rows
_BETTER = 2.0  # times nearer to the pixels: another scale, where the same fits as well

Place = Callable[[np.ndarray, np.ndarray, np.ndarray, int, int], Layout | None]


@dataclass(frozen=True)
class _Finite:
    """The rows ``[n]`` that are looked at, and their means ``[n,3]`` float64."""

    rows: np.ndarray
    points: np.ndarray


def dropped_readings(clues: Clues) -> list[Evidence]:
    """Readings with pixels missing, in the orders that may be: the next one is tried only where none fits."""
    found: list[Evidence] = []
    missing = len(clues.cameras) * clues.cameras.width * clues.cameras.height - len(clues.gaussians)
    rows = np.flatnonzero(clues.valid.numpy())
    finite = _Finite(rows, clues.gaussians.means.numpy()[rows].astype(np.float64))
    for order, read in (("view-major", _pruned), ("view-fastest", _interleaved), ("unordered", _unordered)):
        possible = missing > 0 or (missing == 0 and order == "unordered")
        if possible and clues.order in ("auto", order) and not any(evidence.ok for evidence in found):
            found += read(clues, finite)
    return found


def _pruned(clues: Clues, finite: _Finite) -> list[Evidence]:
    """In the frame of the cameras or a told scale; in any other scale, where that does not fit well or at all."""
    told = clues.scale is not None
    same = _placed(clues, finite, pruned_layout, SAME if clues.scale is None else scaled(clues.scale, ", as told"))
    if same is not None and same.worst_px >= _SURELY_PX and _mostly_missing(same):
        same = replace(same, ok=False)  # with so many pixels to choose from, any row is near to one
    if told or (same is not None and same.worst_px < _SURELY_PX):
        return [] if same is None else [same]
    other = _pruned_and_scaled(clues, finite)
    if other is None or same is None:
        return [found for found in (same, other) if found is not None]
    return [other if other.ok and (other.worst_px * _BETTER < same.worst_px or not same.ok) else same]


def _mostly_missing(found: Evidence) -> bool:
    layout = found.layout
    return 2 * sum(len(rows) for rows in layout.rows) < len(layout.views) * layout.width * layout.height


def _pruned_and_scaled(clues: Clues, finite: _Finite) -> Evidence | None:
    """Scale and pixels in turn, until neither changes."""
    scale = rough_scale(finite.points, clues.viewmats, clues.Ks)
    found = _placed(clues, finite, pruned_layout, scaled(scale))
    if found is None:
        return None
    points = clues.gaussians.means.numpy().astype(np.float64)
    frame = scaled(finer_scale(points, found.layout, clues.viewmats, clues.Ks, scale))
    for _ in range(_ROUNDS):
        now = _placed(clues, finite, pruned_layout, frame)
        if now is None or now.worst_px > _AS_GOOD * found.worst_px:
            break
        found = now
        seen, _ = sightings(clues, sampled(found.layout), colored=False)
        finer = (other for other in candidate_frames(seen, clues.viewmats, clues.Ks, effort=1) if other.scale != 1)
        frame = next(finer, frame)
    return replace(found, ok=found.ok and found.worst_px < _SURELY_PX)


def _interleaved(clues: Clues, finite: _Finite) -> list[Evidence]:
    frame = SAME if clues.scale is None else scaled(clues.scale, ", as told")
    found = _placed(clues, finite, interleaved_layout, frame)
    return [] if found is None else [found]


def _unordered(clues: Clues, finite: _Finite) -> list[Evidence]:
    """Only in frames that nothing has to be solved for: without an order no pixel is known before the frame is."""
    base, color_of = 0.5 + SH_C0 * clues.gaussians.sh0.numpy()[finite.rows, 0], None
    if clues.images is not None:
        photos = clues.images.numpy().reshape(len(clues.cameras), -1, 3)

        def color_of(rows: np.ndarray, view: int, pixels: np.ndarray) -> np.ndarray:
            return np.abs(base[rows].clip(0, 1) - photos[view, pixels]).mean(1)

    nothing = Sightings(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros(0, np.int64))
    for frame in candidate_frames(nothing, clues.viewmats, clues.Ks, scale=clues.scale, effort=0):
        found = _placed(clues, finite, partial(unordered_layout, color_of=color_of), frame)
        if found is not None:
            return [found]
    return []


def _placed(clues: Clues, finite: _Finite, place: Place, frame: Frame) -> Evidence | None:
    """What one way of finding pixels finds in one frame, measured; only finite rows are shown to it."""
    cameras = clues.cameras
    layout = place(finite.points, frame.move_cameras(clues.viewmats), clues.Ks, cameras.width, cameras.height)
    if layout is None:
        return None
    return measured(clues, replace(layout, rows=tuple(finite.rows[some] for some in layout.rows)), frame)
