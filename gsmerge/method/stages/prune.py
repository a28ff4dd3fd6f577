"""Fitted Gaussians -> pruned Gaussians: drop Gaussians that nobody sees.

After a fit many Gaussians are faint or hidden by others. Photos change less without these Gaussians than by rounding to
eight bits, but every viewer would have to load and draw these Gaussians.
"""

from __future__ import annotations

import math

import numpy as np

from gsmerge.method.fit import peak_weights
from gsmerge.method.geometry.views import pick_views
from gsmerge.method.raster import make_splats
from gsmerge.method.raster.photos import Photos, blank_photos, photo_errors
from gsmerge.runtime.record import stage
from gsmerge.types import Cameras, Gaussians

ROUNDING = 1 / (255 * math.sqrt(12))  # root mean square of the change that rounding to eight bits makes
TARGET_CHANGE = 0.9 * ROUNDING  # each next limit is chosen so that it should make this change
ENOUGH_CHANGE = 0.75 * ROUNDING  # change at which the search for a larger limit ends
# Blending weights are measured in pictures whose sides are divided by the first number, and pictures with sides divided
# by the second one are compared. The smaller pictures have the low-pass of the photos, so changes have the same root
# mean square in them as in the photos
COMPARED_LEVELS = 2, 4


@stage("prune")
def split_unseen(gaussians: Gaussians, cameras: Cameras) -> tuple[Gaussians, Gaussians]:
    """Return the Gaussians that ``cameras`` see, and the Gaussians that no camera sees.

    A Gaussian is unseen if its largest blending weight is below a limit. The limit is the largest one found with which
    no picture changes by more than ``ROUNDING`` (root mean square) if the unseen Gaussians are left out. Unseen
    Gaussians are returned in the order of their weights, the largest first. Gaussians outside of all pictures count as
    seen.
    """
    peaks, inside = peak_weights(gaussians, blank_photos(cameras, COMPARED_LEVELS[0]))
    peaks[~inside] = np.inf
    max_compared_views = 8  # pictures with and without the Gaussians are compared in at most this many views
    views = pick_views(len(cameras), max_compared_views)
    limit = _find_limit(gaussians, peaks, blank_photos(cameras[views], COMPARED_LEVELS[1])) if views else 0.0
    unseen = np.flatnonzero(peaks < limit)
    return gaussians[np.flatnonzero(peaks >= limit)], gaussians[unseen[np.argsort(-peaks[unseen], kind="stable")]]


def _find_limit(gaussians: Gaussians, peaks: np.ndarray, photos: Photos) -> float:
    """Try some limits, and return the largest one that is not noticed, or 0 if all are noticed.

    A limit is noticed if a picture changes by more than ``ROUNDING`` without the Gaussians whose largest blending
    weight, in ``peaks [n]``, is below the limit.
    """
    start_limit = 0.02  # limit of the first trial
    # Limits up to `low` are not noticed, and limits from `high` on are noticed
    splats = make_splats(gaussians)
    low = 0.0
    high = math.inf
    limit = start_limit

    def clip(_: int, image: np.ndarray, __: np.ndarray) -> np.ndarray:
        """Clip a render as a picture on a screen is."""
        return np.clip(image, 0, 1, out=image)

    whole = photo_errors(splats, photos, clip)

    def measure_change(limit: float) -> float:
        """Return the largest change of a picture (root mean square) without the Gaussians below the limit."""
        shown = peaks >= limit

        def compare(view: int, image: np.ndarray, transmittance: np.ndarray) -> float:
            """Return the mean squared difference between a render and the render of all Gaussians."""
            return float(((clip(view, image, transmittance) - whole[view]) ** 2).mean(dtype=np.float64))

        return math.sqrt(max(photo_errors(splats, photos, compare, keep=lambda _: shown)))

    trials = 6  # most limits that are tried
    # bounds of the factor on a limit that is too large, and on one that is not
    min_decrease = 0.8
    max_increase = 2.0
    for _ in range(trials):
        is_noticed = (change := measure_change(limit)) > ROUNDING
        low, high = (low, limit) if is_noticed else (limit, high)
        factor = math.sqrt(TARGET_CHANGE / max(change, 1e-9))  # a change grows about with the square of its limit
        limit *= min(factor, min_decrease if is_noticed else max_increase)
        if low and (change > ENOUGH_CHANGE or not low < limit < high):
            break
    return low
