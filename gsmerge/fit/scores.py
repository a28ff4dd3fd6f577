"""Scores of a fit: PSNR on held-out patches, and errors of whole photos."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmerge.fit.fit_state import State
from gsmerge.fit.photo_sizes import holdout_psnr
from gsmerge.fit.schedule import FitRun
from gsmerge.raster.photos import Photos, photo_errors, render_photos
from gsmerge.types import Gaussians


def score_images(images: Sequence[np.ndarray], run: FitRun, half: Photos) -> float:
    """Return the PSNR (dB) of renders on the held-out patches of the half-size photos; NaN if nothing is held out."""
    options = run.job.options
    if options.fit == "none" or not options.judged:
        return float("nan")
    return holdout_psnr(images, half, run.weights, options.tuning.min_gain)


def score_state(state: State, run: FitRun, half: Photos) -> float:
    """Return the PSNR (dB) of a state on the held-out patches of the half-size photos; see :func:`score_images`."""
    return score_images(render_photos(state.splats, half, colors=state.view_colors()), run, half)


def photo_error(gaussians: Gaussians, photos: Photos) -> float:
    """Return the mean squared error of renders against whole photos."""

    def score(view: int, image: np.ndarray, _: np.ndarray) -> float:
        return float(((np.clip(image, 0, 1) - photos.images[view]) ** 2).mean(dtype=np.float64))

    return float(np.mean(photo_errors(gaussians, photos, score)))
