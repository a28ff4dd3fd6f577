"""Find stretches of rows in a photo by their colours."""

from __future__ import annotations

import numpy as np

from gsmerge.geometry import sh0_to_rgb
from gsmerge.types import Gaussians

OUTSIDE = 999  # a colour that no pixel has
UNIQUE = 1.1  # times as far as the nearest place is the next one, at least
_STEP = 2  # every how many pixels of a stretch are compared


def byte_colors(gaussians: Gaussians) -> np.ndarray:
    """Return the base colours ``[3,n]`` of Gaussians as int16 from 0 to 255."""
    return np.ascontiguousarray(np.rint(255 * base_colors(gaussians)).astype(np.int16).T)


def base_colors(gaussians: Gaussians) -> np.ndarray:
    """Return the base colours ``[n,3]`` of Gaussians, 0 to 1; 0 for NaN."""
    with np.errstate(invalid="ignore"):
        return np.nan_to_num(sh0_to_rgb(gaussians.sh0[:, 0])).clip(0, 1)


def shown_colors(photo: np.ndarray, pixels: np.ndarray, length: int) -> np.ndarray:
    """Return the colours ``[3,p+length]`` int16 at ``pixels [p]`` of a uint8 ``photo [h,w,3]``, padded at the end."""
    shown = photo.reshape(-1, 3)[pixels].T.astype(np.int16)
    return np.concatenate([shown, np.full((3, length), OUTSIDE, np.int16)], 1)


def place_stretch(shown: np.ndarray, wanted: np.ndarray, low: int, high: int) -> tuple[int, int, int]:
    """Find the place of the colours ``wanted [3,l]`` in ``shown [3,m]`` by the sum of absolute differences.

    Returns the best place, from ``low`` on and below ``high``, its sum, and the sum of the next best place.
    """
    sums, difference = np.zeros(high - low, np.int32), np.empty(high - low, np.int16)
    for offset in range(0, wanted.shape[1], _STEP):
        for channel in range(3):
            values = shown[channel, low + offset : high + offset]
            np.subtract(values, wanted[channel, offset], out=difference)
            np.abs(difference, out=difference)
            sums += difference
    best = int(sums.argmin())
    other_sums = np.concatenate([sums[: max(0, best - 2)], sums[best + 3 :]])
    return low + best, int(sums[best]), int(other_sums.min(initial=np.iinfo(np.int32).max))
