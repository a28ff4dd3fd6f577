"""Photos larger than what Gaussians without pixels can show, brought to a size that is worth working at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gsmerge.io.alignment.crop import Size, stretch
from gsmerge.io.alignment.grid import Photos, photo_size
from gsmerge.types import Cameras

_MAX_BYTES = 2 << 30  # of all photos as floats, before it is known whether the Gaussians belong to pixels
_FLOAT_PIXEL = 12  # bytes


def within(size: Size, max_side: int) -> Size:
    """(width, height) of the same shape, the longer side at most ``max_side`` pixels."""
    scale = min(1.0, max_side / max(size))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def lighter_photos(photos: Photos | None, rows: int, max_side: int, *, loose: bool) -> tuple[Photos | None, list[str]]:
    """Decoded photos at a size that memory has room for; and a note of it.

    Args:
        photos: c uint8 photos of one size.
        rows: Gaussians of the file: where they may be the photos' pixels as they stand, the photos stay.
        max_side: Pixels of the longer side of what does not fit.
        loose: Whether the Gaussians are told to belong to no pixels: then no photo is larger than that.
    """
    size = photo_size(photos)
    if photos is None or size is None or max(size) <= max_side:
        return photos, []
    pixels = len(photos) * size[0] * size[1]
    if not loose and (_FLOAT_PIXEL * pixels <= _MAX_BYTES or 2 * rows > pixels):
        return photos, []
    to = within(size, max_side)
    return stretch(size, to).photos(photos), [_note(size, to, max_side)]


def lighter_views(cameras: Cameras, images: Tensor | None, max_side: int) -> tuple[Cameras, Tensor | None, list[str]]:
    """Cameras and photos ``[c,h,w,3]`` of Gaussians without pixels, no side longer than ``max_side``; and a note."""
    size = cameras.width, cameras.height
    if max(size) <= max_side:
        return cameras, images, []
    to = within(size, max_side)
    mapping = stretch(size, to)
    smaller = replace(cameras, Ks=mapping.intrinsics(cameras.Ks), width=to[0], height=to[1])
    if images is not None:
        images = torch.from_numpy(np.stack(mapping.photos(images.numpy())))
    return smaller, images, [_note(size, to, max_side)]


def _note(size: Size, to: Size, max_side: int) -> str:
    return (
        f"views of {size[0]} x {size[1]} are worked on at {to[0]} x {to[1]}: no side is longer than {max_side} pixels"
        " (max_side)"
    )
