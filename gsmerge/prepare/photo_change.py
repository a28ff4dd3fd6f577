"""Changes that make a photo look like its Gaussians, applied at every size at which it is read."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.method.compare.colors import map_tones
from gsmerge.types import LargePhotos

LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # brightness of red, green and blue, as in JPEGs (Rec. 601)
LOOK_OF_PHOTOS = "--set look=photos keeps the photos"  # what a user can do about a rule
KEEP = f" ({LOOK_OF_PHOTOS})"
CLIPPED = 0.985  # a pixel may be clipped from this level on


@dataclass(frozen=True, eq=False)
class PhotoChange:
    """Changes of one photo: more light, a new value for each level, then new colours at the pixels of ``cover``."""

    tones: np.ndarray | None = None  # [3,256] float32, new value of each level of each channel
    cover: np.ndarray | None = None  # [h,w] bool, pixels that get `colors`
    colors: np.ndarray | None = None  # [h,w,3] sRGB in [0, 1]
    keeps_brightness: bool = False  # True: covered pixels get only the hue of `colors`; False: its brightness, too
    light: np.ndarray | None = None  # [h,w] in (0, 1], by which the photo is divided

    def __bool__(self) -> bool:
        """Return whether the photo changes at all."""
        return any(part is not None for part in (self.light, self.tones, self.cover))

    def __call__(self, photo: np.ndarray) -> np.ndarray:
        """Return a changed photo ``[h,w,3]`` float32 in [0, 1]; photos are as large as light and cover, or larger."""
        if self.light is not None:
            light = self.light if self.light.shape == photo.shape[:2] else _enlarge(self.light, photo.shape)
            photo = (photo / light[..., None]).clip(0, 1)
        if self.tones is not None:
            photo = map_tones(self.tones, photo)
        if self.cover is not None and self.colors is not None:
            cover = self.cover
            colors = self.colors
            if cover.shape != photo.shape[:2]:
                cover = _enlarge(cover, photo.shape) > 0
                colors = _enlarge(colors, photo.shape)
            if self.keeps_brightness:
                colors = (colors + ((photo - colors) * LUMA).sum(-1, keepdims=True)).clip(0, 1)
            photo = np.where(cover[..., None], colors, photo)
        return np.ascontiguousarray(photo, np.float32)


def _enlarge(picture: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Enlarge a picture in [0, 1] as integers, which OpenCV resizes to equal values on every processor."""
    levels = np.rint(255 * picture.astype(np.float32).clip(0, 1)).astype(np.uint8)
    return np.asarray(cv2.resize(levels, shape[1::-1], interpolation=cv2.INTER_LINEAR) / np.float32(255))


def change_large(large: LargePhotos, changes: Sequence[PhotoChange]) -> LargePhotos:
    """Return the large photos so that each is changed when it is read."""

    def read(view: int) -> np.ndarray:
        """Read the large photo of a view, and change it."""
        photo = large.read(large.ids[view])
        if not changes[view]:
            return photo
        return np.asarray(np.rint(255 * changes[view](photo / np.float32(255)).clip(0, 1)), np.uint8)

    return replace(large, ids=tuple(range(len(changes))), read=read)
