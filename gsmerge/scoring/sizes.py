"""Resize cameras, photos and masks, so that renders have the size of the photos with which they are compared."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from gsmerge.io.photo_files import limit_size
from gsmerge.method.geometry.views import resize_cameras
from gsmerge.method.kernels.pictures import enlarge
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Views

SomeViews = TypeVar("SomeViews", bound=Views)


def shrink_cameras(cameras: Cameras, side: int) -> Cameras:
    """Shrink the image size of cameras to at most ``side`` pixels on the longer side.

    If ``side`` is 0, the size stays.
    """
    size = cameras.width, cameras.height
    smaller = limit_size(size, side or max(size))
    return cameras if smaller == size else resize_cameras(cameras, *smaller)


def fill_cameras(cameras: Cameras, width: int, height: int) -> Cameras:
    """Return cameras whose images ``[height,width]`` are resized and cropped, like those of :func:`fill_photo`.

    The old image is resized until it covers the new size. What exceeds the new size is cropped evenly at both ends.
    """
    new_width, new_height = _filling_size(cameras.width, cameras.height, width, height)
    resized = resize_cameras(cameras, new_width, new_height)
    Ks = resized.Ks.astype(np.float64)
    Ks[:, :2, 2] -= (new_width - width) // 2, (new_height - height) // 2
    return replace(resized, Ks=Ks, width=width, height=height)


def fill_photo(photo: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resize and crop a photo ``[h,w,3]`` to ``[height,width,3]``.

    :func:`fill_cameras` changes the photo's camera likewise.
    """
    new_width, new_height = _filling_size(photo.shape[1], photo.shape[0], width, height)
    top = (new_height - height) // 2
    left = (new_width - width) // 2
    return resize_photo(photo, new_width, new_height)[top : top + height, left : left + width]


def _filling_size(old_width: int, old_height: int, width: int, height: int) -> tuple[int, int]:
    """Return the smallest width and height that cover ``width`` x ``height`` and keep the old aspect ratio."""
    scale = max(width / old_width, height / old_height)
    return max(width, round(scale * old_width)), max(height, round(scale * old_height))


def shrink_views(views: SomeViews, side: int) -> SomeViews:
    """Shrink photos and cameras to at most ``side`` pixels on the longer side.

    If ``side`` is 0, both keep their size.
    """
    cameras = shrink_cameras(views.cameras, side)
    if cameras is views.cameras:
        return views
    size = cameras.width, cameras.height
    images = np.stack(parallel_map(lambda photo: resize_photo(photo, *size), views.images))
    return replace(views, cameras=cameras, images=images)


def resize_photo(photo: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resize a photo ``[h,w,3]``: area averages shrink photos, cubic interpolation enlarges photos."""
    if width * height < photo.shape[0] * photo.shape[1]:
        resized = cv2.resize(photo, (width, height), interpolation=cv2.INTER_AREA)
    else:
        resized = enlarge(photo, width, height)
    return np.asarray(resized).clip(0, 1)


def resize_mask(mask: NDArray[np.bool_], width: int, height: int) -> NDArray[np.bool_]:
    """Resize a mask ``[h,w]`` to ``[height,width]``; a new pixel is True if it lies completely inside the mask."""
    # A summed-area table [h+1,w+1]: element [y,x] counts the pixels outside the mask in the rows < y and columns < x
    sums = np.pad(np.cumsum(np.cumsum(~mask, 0, dtype=np.int64), 1), ((1, 0), (1, 0)))
    top, bottom = _overlapped_range(mask.shape[0], height)
    left, right = _overlapped_range(mask.shape[1], width)
    num_outside = sums[bottom][:, right] - sums[top][:, right] - sums[bottom][:, left] + sums[top][:, left]
    return np.asarray(num_outside == 0)


def _overlapped_range(old: int, new: int) -> tuple[np.ndarray, np.ndarray]:
    """Return which pixels of a line of ``old`` pixels each pixel overlaps after the line is resized to ``new`` pixels.

    The first array ``[new]`` has the first overlapped old pixel, and the second array ``[new]`` the old pixel after the
    last overlapped one.
    """
    pixel = np.arange(new)
    return pixel * old // new, -(-(pixel + 1) * old // new)
