"""From photos to the picture that a network saw: resized, or resized and cropped, intrinsics alike."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from gsmerge.io.alignment.layouts import PER_PIXEL, TRIM
from gsmerge.io.alignment.mismatch import ASPECT_TOLERANCE
from gsmerge.runtime.threads import parallel_map

Size = tuple[int, int]  # width, height

PATCH = 14  # sides of vision transformers' inputs are multiples of it
SIDES = (504, 518)  # to which Depth Anything 3 and others resize the longer or the shorter side
_ROUND = (8, PATCH)  # sides of grids that photos are cropped to
_MIN_KEPT = 0.5  # of a photo's area, when it is cropped


@dataclass(frozen=True)
class Mapping:
    """A photo is resized, then cut: ``u' = scale_x u - left`` and ``v' = scale_y v - top``, pixels.

    Args:
        width: Of the result, pixels.
        height: The same.
        scale_x: Along the width.
        scale_y: Along the height.
        left: Columns cut off at the left.
        top: Rows cut off at the top.
    """

    width: int
    height: int
    scale_x: float
    scale_y: float
    left: int = 0
    top: int = 0

    @property
    def is_whole(self) -> bool:
        """Whether nothing is cut off."""
        return not (self.left or self.top)

    @property
    def words(self) -> str:
        """What is done to a photo."""
        return f"resized{'' if self.is_whole else ' and centre-cropped'} to {self.width} x {self.height}"

    def intrinsics(self, Ks: Tensor) -> Tensor:
        """``[c,3,3]`` intrinsics of the result."""
        matrix = [[self.scale_x, 0.0, -self.left], [0.0, self.scale_y, -self.top], [0.0, 0.0, 1.0]]
        return torch.tensor(matrix, dtype=torch.float64) @ Ks.double()

    def photos(self, images: Sequence[np.ndarray] | np.ndarray) -> list[np.ndarray]:
        """The results for c uint8 photos ``[h,w,3]``."""

        def one(image: np.ndarray) -> np.ndarray:
            height, width = image.shape[:2]
            size = round(width * self.scale_x), round(height * self.scale_y)
            shrinks = size[0] * size[1] < width * height
            whole = cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
            return np.ascontiguousarray(whole[self.top : self.top + self.height, self.left : self.left + self.width])

        return parallel_map(one, list(images))


def stretch(size: Size, to: Size) -> Mapping:
    """Each side by itself."""
    return Mapping(*to, to[0] / size[0], to[1] / size[1])


def cover(size: Size, to: Size) -> Mapping:
    """Both sides alike until the result is covered, then the middle of it."""
    return _middle(size, to, max(to[0] / size[0], to[1] / size[1]))


def _middle(size: Size, to: Size, scale: float) -> Mapping:
    """Both sides alike, then the middle: sides are whole pixels before the cut."""
    width, height = (max(side, round(whole * scale)) for side, whole in zip(to, size, strict=True))
    return Mapping(*to, width / size[0], height / size[1], (width - to[0]) // 2, (height - to[1]) // 2)


def counted(count: int, views: int, size: Size) -> Iterator[Mapping]:
    """Mappings to smaller grids that the number of rows allows, with as many rows for each of all views.

    Args:
        count: Rows of the file.
        views: Cameras.
        size: Of the photos, pixels.
    """
    crops: list[Mapping] = []
    for trim in (0, TRIM):
        for per_pixel in PER_PIXEL:
            pixels, rest = divmod(count, views * per_pixel)
            if rest:
                continue
            for to in _grids(pixels, trim, size):
                aspect = to[0] * size[1] / (to[1] * size[0])
                if abs(aspect - 1) <= ASPECT_TOLERANCE:
                    yield stretch(size, to)
                is_round = to[0] == to[1] or any(to[0] % side == to[1] % side == 0 for side in _ROUND)
                if to[0] * to[1] < size[0] * size[1] and min(aspect, 1 / aspect) >= _MIN_KEPT and is_round:
                    crops.append(cover(size, to))
    yield from (crop for crop in crops if not crop.is_whole)


def _grids(pixels: int, trim: int, size: Size) -> Iterator[Size]:
    for width in range(max(1, pixels // size[1]), min(size[0], pixels) + 1):
        height, rest = divmod(pixels, width)
        to = width + 2 * trim, height + 2 * trim
        if not rest and to != size and to[0] <= size[0] and to[1] <= size[1]:
            yield to


def patched(size: Size) -> Iterator[Mapping]:
    """Mappings of networks that take multiples of 14: each side to the nearest one, or cut down to it."""
    seen = set()
    for side in SIDES:
        for whole in (max(size), min(size)):
            scale = side / whole
            nearest = tuple(PATCH * max(1, round(s * scale / PATCH)) for s in size)
            below = tuple(PATCH * max(1, int(round(s * scale) // PATCH)) for s in size)
            for mapping in (stretch(size, (nearest[0], nearest[1])), _middle(size, (below[0], below[1]), scale)):
                if mapping not in seen and scale <= 1:
                    seen.add(mapping)
                    yield mapping
