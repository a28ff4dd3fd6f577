"""Readings of files that lack pixels without saying which, or have them in no order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from gsmerge.geometry import sh0_to_rgb
from gsmerge.io.alignment.interleaved import interleaved_layout
from gsmerge.io.alignment.layouts import Layout
from gsmerge.io.alignment.projected_rows import ProjectedRows
from gsmerge.io.alignment.pruned import finer_scale, pruned_layout, rough_scale
from gsmerge.io.alignment.score import AlignmentInput, AlignmentScore, find_correspondences, sample_layout, score_layout
from gsmerge.io.alignment.similarity import IDENTITY, Similarity, candidate_similarities, scale_by
from gsmerge.io.alignment.unordered import unordered_layout

_ROUNDS = 3  # of a layout and the scale that follows from it
_CERTAIN_PX = 0.3  # median distance that a search does not reach in a wrong frame
_AS_GOOD = 1.05  # of that distance: no worse, where the scale is solved from more rows
_BETTER = 2.0  # times nearer to the pixels: another scale, where the same fits as well


def score_incomplete(inputs: AlignmentInput) -> list[AlignmentScore]:
    """Readings with pixels missing, in the possible orders: the next one is tried only where none fits."""
    scores: list[AlignmentScore] = []
    width, height = inputs.cameras.width, inputs.cameras.height
    missing = len(inputs.cameras) * width * height - len(inputs.gaussians)
    ids = np.flatnonzero(inputs.valid)
    points = inputs.gaussians.means[ids].astype(np.float64)
    rows = ProjectedRows(points, ids, inputs.cameras.viewmats, inputs.cameras.Ks, width, height)
    for order, read in (("view-major", _pruned), ("view-fastest", _interleaved), ("unordered", _unordered)):
        possible = missing > 0 or (missing == 0 and order == "unordered")
        if possible and inputs.order in ("auto", order) and not any(score.ok for score in scores):
            score = read(inputs, rows)
            scores += [] if score is None else [score]
    return scores


def _pruned(inputs: AlignmentInput, rows: ProjectedRows) -> AlignmentScore | None:
    """In the frame of the cameras or at a given scale; at any other scale, where that does not fit well or at all."""
    same = _search(inputs, rows, pruned_layout, _given_frame(inputs))
    if same is not None and same.worst_px >= _CERTAIN_PX:
        num_pixels, num_rows = len(same.layout.views) * rows.width * rows.height, sum(map(len, same.layout.rows))
        if 2 * num_rows < num_pixels:  # with so many pixels to choose from, any row is near to one
            same = replace(same, ok=False)
    if inputs.scale is not None or (same is not None and same.worst_px < _CERTAIN_PX):
        return same
    other = _pruned_and_scaled(inputs, rows)
    if other is None or same is None:
        return other or same
    return other if other.ok and (other.worst_px * _BETTER < same.worst_px or not same.ok) else same


def _pruned_and_scaled(inputs: AlignmentInput, rows: ProjectedRows) -> AlignmentScore | None:
    """Scale and pixels in turn, until neither changes."""
    scale = rough_scale(rows)
    best = _search(inputs, rows, pruned_layout, scale_by(scale))
    if best is None:
        return None
    every = replace(rows, points=inputs.gaussians.means.astype(np.float64))
    frame = scale_by(finer_scale(every, best.layout, scale))
    for _ in range(_ROUNDS):
        score = _search(inputs, rows, pruned_layout, frame)
        if score is None or score.worst_px > _AS_GOOD * best.worst_px:
            break
        best = score
        pairs = find_correspondences(inputs.gaussians.means, inputs.valid, sample_layout(best.layout))
        finer = (
            f
            for f in candidate_similarities(pairs, inputs.cameras.viewmats, inputs.cameras.Ks, effort=1)
            if f.scale != 1
        )
        frame = next(finer, frame)
    return replace(best, ok=best.ok and best.worst_px < _CERTAIN_PX)


def _interleaved(inputs: AlignmentInput, rows: ProjectedRows) -> AlignmentScore | None:
    return _search(inputs, rows, interleaved_layout, _given_frame(inputs))


def _unordered(inputs: AlignmentInput, rows: ProjectedRows) -> AlignmentScore | None:
    """Only in frames that need no solving: without an order no pixel is known before the frame is."""
    base, color_of = sh0_to_rgb(inputs.gaussians.sh0[rows.ids, 0]), None
    if inputs.images is not None:
        photos = inputs.images.reshape(len(inputs.cameras), -1, 3)

        def color_of(some: np.ndarray, view: int, pixels: np.ndarray) -> np.ndarray:
            return np.abs(base[some].clip(0, 1) - photos[view, pixels]).mean(1)

    frames = candidate_similarities(None, inputs.cameras.viewmats, inputs.cameras.Ks, scale=inputs.scale, effort=0)
    scores = (_search(inputs, rows, partial(unordered_layout, color_of=color_of), frame) for frame in frames)
    return next((score for score in scores if score is not None), None)


def _given_frame(inputs: AlignmentInput) -> Similarity:
    return IDENTITY if inputs.scale is None else scale_by(inputs.scale, ", as given")


def _search(
    inputs: AlignmentInput, rows: ProjectedRows, search: Callable[[ProjectedRows], Layout | None], frame: Similarity
) -> AlignmentScore | None:
    """The score of what one search makes of the rows in one frame."""
    layout = search(replace(rows, viewmats=frame.move_viewmats(inputs.cameras.viewmats)))
    return None if layout is None else score_layout(inputs, layout, frame)
