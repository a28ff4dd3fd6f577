"""The same views at other sizes: cameras, photos and masks, as a viewer that is zoomed in or out needs them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gsmerge.measure.speed import resized
from gsmerge.types import Cameras


def zoom_cameras(cameras: Cameras, zoom: float) -> Cameras:
    """The same cameras with images of ``zoom`` times as many pixels per side, and intrinsics of that size."""
    return resized(cameras, max(1, round(zoom * max(cameras.width, cameras.height))))


def resize_photo(photo: np.ndarray, width: int, height: int) -> np.ndarray:
    """A photo ``[h,w,3]`` at another size, pixels: area averages where it is smaller, cubic where it is larger."""
    smaller = width * height < photo.shape[0] * photo.shape[1]
    way = cv2.INTER_AREA if smaller else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(photo, (width, height), interpolation=way)).clip(0, 1)


def resize_mask(mask: NDArray[np.bool_], width: int, height: int) -> NDArray[np.bool_]:
    """``[height,width]``: the pixels of another size of which every part lies in the mask ``[h,w]``."""
    holes = np.pad(np.cumsum(np.cumsum(~mask, 0, dtype=np.int64), 1), ((1, 0), (1, 0)))
    (top, bottom), (left, right) = (
        _covered(old, new) for old, new in zip(mask.shape, (height, width), strict=True)
    )  # fmt: skip
    inside = holes[bottom][:, right] - holes[top][:, right] - holes[bottom][:, left] + holes[top][:, left]
    return np.asarray(inside == 0)


def _covered(old: int, new: int) -> tuple[np.ndarray, np.ndarray]:
    """First pixel, and the one after the last, of ``old`` in a row that each of ``new`` pixels overlaps."""
    pixel = np.arange(new)
    return pixel * old // new, -(-(pixel + 1) * old // new)
