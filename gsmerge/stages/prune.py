"""Fitted Gaussians -> pruned Gaussians: Gaussians that nobody sees are dropped.

After a fit many Gaussians are faint, or hidden by others. They change no photo by more than rounding to eight bits
does, but every viewer has to load and draw them.
"""

from __future__ import annotations

import math

import numpy as np

from gsmerge.facts.views import pick_views
from gsmerge.fit import peak_weights
from gsmerge.raster import make_splats
from gsmerge.raster.photos import Photos, blank_photos, photo_errors
from gsmerge.runtime.record import stage
from gsmerge.types import Cameras, Gaussians

ROUNDING = 1 / (255 * math.sqrt(12))  # root mean square of the change by rounding to eight bits
FIRST = 0.02  # limit of the first trial: Gaussians with a smaller largest blending weight are left out
TRIALS, AIM, CLOSE = 6, 0.9, 0.75  # most limits that are tried; shares of ROUNDING to aim at, and that are enough
LESS = 0.8  # a limit that is too large is lowered at least by this factor
COMPARED = 8  # most views in which pictures with and without the Gaussians are compared
# Sizes of pixels, relative to the photos': of pictures in which weights are found, and of pictures that are compared.
# These pixels are samples of the photo, with the same low-pass, so the root mean square is the same
LEVELS = 2, 4


@stage("prune")
def split_unseen(gaussians: Gaussians, cameras: Cameras) -> tuple[Gaussians, Gaussians]:
    """Split Gaussians into those that ``cameras`` see and those that they do not; the most visible of these come first.

    A Gaussian is unseen if its largest blending weight is below a limit. The limit is as large as possible, while the
    pictures of no camera change by more than ``ROUNDING`` (root mean square) without the unseen Gaussians. Gaussians
    outside of all pictures count as seen.
    """
    peaks, inside = peak_weights(gaussians, blank_photos(cameras, LEVELS[0]))
    peaks[~inside] = np.inf
    views = pick_views(len(cameras), COMPARED)
    least = _least_weight(gaussians, peaks, blank_photos(cameras[views], LEVELS[1])) if views else 0.0
    unseen = np.flatnonzero(peaks < least)
    return gaussians[np.flatnonzero(peaks >= least)], gaussians[unseen[np.argsort(-peaks[unseen], kind="stable")]]


def _least_weight(gaussians: Gaussians, peaks: np.ndarray, photos: Photos) -> float:
    """Find the largest limit, of those that are tried, below which all Gaussians can be left out; 0: there is none."""
    splats, least, most, weight = make_splats(gaussians), 0.0, math.inf, FIRST

    def clip(_: int, image: np.ndarray, __: np.ndarray) -> np.ndarray:
        return np.clip(image, 0, 1, out=image)

    whole = photo_errors(splats, photos, clip)

    def measure_change(weight: float) -> float:
        """Measure the change (root mean square) of the picture that changes most without smaller weights."""
        shown = peaks >= weight

        def compare(view: int, image: np.ndarray, transmittance: np.ndarray) -> float:
            return float(((clip(view, image, transmittance) - whole[view]) ** 2).mean(dtype=np.float64))

        return math.sqrt(max(photo_errors(splats, photos, compare, keep=lambda _: shown)))

    for _ in range(TRIALS):
        changed = measure_change(weight)
        least, most = (least, weight) if changed > ROUNDING else (weight, most)
        factor = math.sqrt(AIM * ROUNDING / max(changed, 1e-9))  # the change grows about with the square of the limit
        weight *= min(factor, LESS) if changed > ROUNDING else min(factor, 2.0)
        if least and (changed > CLOSE * ROUNDING or not least < weight < most):
            break
    return least
