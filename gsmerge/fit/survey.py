"""Survey of the start of a fit: what the photos show of each Gaussian."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from gsmerge.fit.fit_state import start_state
from gsmerge.fit.schedule import FitPlan
from gsmerge.fit.scores import score_images
from gsmerge.raster import contributions, plan_view, prepare
from gsmerge.raster.composite import survey
from gsmerge.raster.photos import Photos
from gsmerge.runtime.threads import in_turn
from gsmerge.types import Gaussians


@dataclass(frozen=True, eq=False)
class Survey:
    """Facts that half-size photos show about each of the n Gaussians that a fit starts from."""

    score: float  # PSNR (dB) of the held-out blocks of these pictures
    inside: np.ndarray  # [n] bool, whether some photo's frustum may hold it
    peaks: np.ndarray  # [n] float32 largest blending weight
    sums: np.ndarray  # [n] float64 blending weights summed over all photos, pixels
    squares: np.ndarray  # [n] float64 squares of each photo's sum, summed
    pixels: np.ndarray  # [n] float32 size of the finest pixel that shows it, world units; inf if none does

    def visible(self, min_weight: float) -> np.ndarray:
        """Return a mask ``[n]`` of Gaussians with a weight of ``min_weight`` in some photo, or outside all frustums."""
        return ~self.inside | (self.peaks >= min_weight)

    def __getitem__(self, rows: np.ndarray) -> Survey:
        columns = {field.name: getattr(self, field.name)[rows] for field in fields(self) if field.name != "score"}
        return Survey(self.score, **columns)


def survey_photos(gaussians: Gaussians, plan: FitPlan) -> Survey:
    """Draw Gaussians into the half-size photos of a planned fit, and collect how each photo shows each Gaussian.

    The other sizes, full size first, determine the size of the finest pixel. Without a fit the score is NaN.
    """
    photos = plan.job.photos
    state, half, count = start_state(gaussians), photos[1], len(gaussians)
    colors = state.view_colors()

    def one_view(view: int) -> tuple[np.ndarray, ...]:
        drawn = plan_view(state.splats, **half.camera(view))
        focal = max(sized.Ks[view][[0, 1], [0, 1]].max() for sized in photos)
        return drawn.ids, drawn.depths / focal, *survey(drawn, colors)

    images, inside, peaks = [], np.zeros(count, bool), np.zeros(count, np.float32)
    sums, squares, pixels = np.zeros(count), np.zeros(count), np.full(count, np.inf, np.float32)
    for ids, sizes, image, weights, most in in_turn(one_view, range(len(half))):
        images.append(image)
        inside[ids] = True
        peaks[ids] = np.maximum(peaks[ids], most)
        pixels[ids] = np.minimum(pixels[ids], sizes)
        sums[ids] += weights
        squares[ids] += weights.astype(np.float64) ** 2
    return Survey(score_images(images, plan, half), inside, peaks, sums, squares, pixels)


def visible_mask(gaussians: Gaussians, photos: Photos, min_weight: float) -> np.ndarray:
    """Return a mask ``[n]`` of Gaussians with a weight of ``min_weight`` in some photo, or outside all frustums."""
    peaks, inside = peak_weights(gaussians, photos)
    return ~inside | (peaks >= min_weight)


def peak_weights(gaussians: Gaussians, photos: Photos) -> tuple[np.ndarray, np.ndarray]:
    """Return each Gaussian's largest blending weight ``[n]`` over photos, and whether it is in some frustum ``[n]``."""
    splats = prepare(gaussians)

    def one_view(view: int) -> tuple[np.ndarray, np.ndarray]:
        plan = plan_view(splats, **photos.camera(view))
        return plan.ids, contributions(plan)[1]

    peak, inside = np.zeros(len(gaussians), np.float32), np.zeros(len(gaussians), bool)
    for ids, peaks in in_turn(one_view, range(len(photos))):
        inside[ids] = True
        np.maximum(peak, peaks, out=peak)
    return peak, inside
