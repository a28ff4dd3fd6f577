"""Fitted Gaussians -> pruned Gaussians: those that nobody sees are not written.

A fit leaves many Gaussians that are faint, or hidden by others. They change no photo by more than rounding to eight
bits does, but every viewer has to load and draw them.
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

ROUNDING = 1 / (255 * math.sqrt(12))  # root mean square of what rounding to eight bits changes
FIRST = 0.02  # largest blending weight below which Gaussians are left out in the first trial
TRIALS, AIM, CLOSE = 6, 0.9, 0.75  # weights that are tried; shares of ROUNDING that are aimed at, and near enough
LESS = 0.8  # times a weight that is too large is the next one, at most
COMPARED = 8  # views, at most, in which pictures with and without them are compared
# Times a photo's pixel is one in which weights are found, and one of pictures that are compared. Their pixels are
# samples of the photo's, as the low-pass stays, and thus have the same root mean square
LEVELS = 2, 4


@stage("prune")
def split_unseen(gaussians: Gaussians, cameras: Cameras) -> tuple[Gaussians, Gaussians]:
    """Split Gaussians into those that ``cameras`` see, and those that they do not, the clearest of these first.

    Unseen are as many as can go, least blending weight first, while the pictures of no camera change by more than
    ``ROUNDING`` (root mean square). What lies outside of all pictures stays.
    """
    peaks, inside = peak_weights(gaussians, blank_photos(cameras, LEVELS[0]))
    peaks[~inside] = np.inf
    views = pick_views(len(cameras), COMPARED)
    least = _least_weight(gaussians, peaks, blank_photos(cameras[views], LEVELS[1])) if views else 0.0
    unseen = np.flatnonzero(peaks < least)
    return gaussians[np.flatnonzero(peaks >= least)], gaussians[unseen[np.argsort(-peaks[unseen], kind="stable")]]


def _least_weight(gaussians: Gaussians, peaks: np.ndarray, photos: Photos) -> float:
    """Find the largest weight below which all Gaussians can go, of those that are tried; 0 for none."""
    splats, least, most, weight = make_splats(gaussians), 0.0, math.inf, FIRST

    def clip(_: int, image: np.ndarray, __: np.ndarray) -> np.ndarray:
        return np.clip(image, 0, 1, out=image)

    whole = photo_errors(splats, photos, clip)

    def measure_change(weight: float) -> float:
        """Measure the largest root mean square, over the pictures, of what changes without lesser weights."""
        shown = peaks >= weight

        def compare(view: int, image: np.ndarray, left: np.ndarray) -> float:
            return float(((clip(view, image, left) - whole[view]) ** 2).mean(dtype=np.float64))

        return math.sqrt(max(photo_errors(splats, photos, compare, keep=lambda _: shown)))

    for _ in range(TRIALS):
        changed = measure_change(weight)
        least, most = (least, weight) if changed > ROUNDING else (weight, most)
        # what goes changes pictures about as the square of the limit
        by = math.sqrt(AIM * ROUNDING / max(changed, 1e-9))
        weight *= min(by, LESS) if changed > ROUNDING else min(by, 2.0)
        if least and (changed > CLOSE * ROUNDING or not least < weight < most):
            break
    return least
