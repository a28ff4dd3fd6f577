"""Readings of files that lack pixels, nobody knows which, or have them in no order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from gsmerge.io.evidence import Clues, Evidence, measured, sampled, sightings
from gsmerge.io.frame import SAME, Frame, Sightings, candidate_frames
from gsmerge.io.interleaved import interleaved_layout
from gsmerge.io.layouts import Layout
from gsmerge.io.pruned import pruned_layout, refined_scale, rough_frames
from gsmerge.io.unordered import unordered_layout
from gsmerge.types import SH_C0

_ROUNDS = 3  # of a layout and the scale that follows from it

Place = Callable[[np.ndarray, np.ndarray, np.ndarray, int, int], Layout | None]


def dropped_readings(clues: Clues) -> list[Evidence]:
    """Readings with pixels missing, in the orders that may be: the next one is tried only where none fits."""
    found: list[Evidence] = []
    missing = len(clues.cameras) * clues.cameras.width * clues.cameras.height - len(clues.gaussians)
    for order, read in (("view-major", _pruned), ("view-fastest", _interleaved), ("unordered", _unordered)):
        possible = missing > 0 or (missing == 0 and order == "unordered")
        if possible and clues.order in ("auto", order) and not any(evidence.ok for evidence in found):
            found += read(clues)
    return found


def _pruned(clues: Clues) -> list[Evidence]:
    cameras = clues.cameras
    points = clues.gaussians.means.double().numpy()[clues.valid.numpy()]
    out = []
    for frame in rough_frames(points, clues.viewmats, clues.Ks, cameras.width, cameras.height, clues.scale):
        for _ in range(1 if frame is SAME or clues.scale else _ROUNDS):
            found = _placed(clues, pruned_layout, frame)
            if found is None:
                break
            out.append(found)
            seen, _ = sightings(clues, sampled(found.layout), colored=False)
            finer = None if frame is SAME or clues.scale else refined_scale(seen, clues.viewmats, clues.Ks)
            if finer is None:
                break
            frame = finer
        if out and out[-1].ok:
            break
    return out


def _interleaved(clues: Clues) -> list[Evidence]:
    frame = SAME if clues.scale is None else Frame(np.eye(3), clues.scale, np.zeros(3), "scaled, as told", "scaled")
    found = _placed(clues, interleaved_layout, frame)
    return [] if found is None else [found]


def _unordered(clues: Clues) -> list[Evidence]:
    """Only in frames that nothing has to be solved for: without an order no pixel is known before the frame is."""
    base, color_of = 0.5 + SH_C0 * clues.gaussians.sh0.numpy()[clues.valid.numpy(), 0], None
    if clues.images is not None:
        photos = clues.images.numpy().reshape(len(clues.cameras), -1, 3)

        def color_of(rows: np.ndarray, view: int, pixels: np.ndarray) -> np.ndarray:
            return np.abs(base[rows].clip(0, 1) - photos[view, pixels]).mean(1)

    nothing = Sightings(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros(0, np.int64))
    for frame in candidate_frames(nothing, clues.viewmats, clues.Ks, scale=clues.scale, effort=0):
        found = _placed(clues, partial(unordered_layout, color_of=color_of), frame)
        if found is not None:
            return [found]
    return []


def _placed(clues: Clues, place: Place, frame: Frame) -> Evidence | None:
    """What one way of finding pixels finds in one frame, measured; only finite rows are shown to it."""
    rows = np.flatnonzero(clues.valid.numpy())
    points, cameras = clues.gaussians.means.double().numpy()[rows], clues.cameras
    layout = place(points, frame.move_cameras(clues.viewmats), clues.Ks, cameras.width, cameras.height)
    if layout is None:
        return None
    return measured(clues, replace(layout, rows=tuple(rows[some] for some in layout.rows)), frame)
