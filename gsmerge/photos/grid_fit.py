"""Find how photos were resized to the grid of a file's rows, whose cameras were estimated.

Models resize photos without their aspect ratio or crop them, and some cut a border off their output. Therefore photos
of any size are compared with the pictures of a grid, which are the colours of its rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from gsmerge.cameras import TRIMS
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.photo_files import PhotoTransform, Size, resize_and_crop, resize_to
from gsmerge.photos.offsets import correlate_parts
from gsmerge.photos.pictures import ViewPictures
from gsmerge.photos.scores import stands_out


@dataclass(frozen=True)
class GridFit:
    """The resizing and cropping by which a model made the pixels of a grid of rows from photos."""

    size: Size  # of the grid
    crops: bool = False  # True: resized in proportion and cropped at the centre; False: width and height independently
    trim: tuple[int, int] = (0, 0)  # columns and lines that the model then cut off at each side

    def transform(self, size: Size) -> PhotoTransform:
        """Return the transform of photos of a size to the grid with the borders that the model cut off."""
        width, height = (side + 2 * cut for side, cut in zip(self.size, self.trim, strict=True))
        return (resize_and_crop if self.crops else resize_to)(size, (width, height))

    def cut(self, photo: np.ndarray) -> np.ndarray:
        """Resize and crop a photo ``[h,w,3]`` of any size to the pixels of the grid.

        If one is landscape and the other portrait, the photo is turned first, and the result is turned back.
        """
        (width, height), (x, y) = self.size, self.trim
        if (photo.shape[1] - photo.shape[0]) * (width - height) < 0:
            return np.rot90(self.cut(np.ascontiguousarray(np.rot90(photo))), -1)
        whole = self.transform((photo.shape[1], photo.shape[0])).photos([photo])[0]
        return np.asarray(whole[y : y + height, x : x + width])

    def cameras(self, camera_file: CameraFile, size: Size) -> CameraFile:
        """Return the cameras of the grid with its borders; their ``photo_map`` is the transform of photos of a size."""
        (left, top), (width, height), Ks = self.trim, self.size, camera_file.Ks.copy()
        assert camera_file.pixel_ids is not None, "estimated cameras are those of pixels"
        Ks[:, :2, 2] += self.trim
        widths, heights = camera_file.widths + 2 * left, camera_file.heights + 2 * top
        lines, x = np.divmod(camera_file.pixel_ids, width)
        views, y = np.divmod(lines, height)
        pixel_ids = (views * (height + 2 * top) + y + top) * (width + 2 * left) + x + left
        pixel_ids = np.where(lines >= 0, pixel_ids, -1)
        photo_map = size, self.transform(size)
        return replace(camera_file, Ks=Ks, widths=widths, heights=heights, pixel_ids=pixel_ids, photo_map=photo_map)


def _da3_borders(side: int) -> list[int]:
    """List the numbers of pixels that Depth Anything 3 may have cut off at both ends if ``side`` pixels are left."""
    return [border for border in range(side) if int(8 / 256 * (side + 2 * border)) == border]


def list_fits(size: Size) -> list[GridFit]:
    """List how models resize and crop photos to a grid of a size, simple fits first."""
    trims = [(trim, trim) for trim in (0, *TRIMS)]
    trims += product(_da3_borders(size[0]), _da3_borders(size[1]))
    return [GridFit(size, crops, trim) for crops in (False, True) for trim in dict.fromkeys(trims)]


def choose_fit(shown: ViewPictures, photos: Sequence[np.ndarray | None], fits: Sequence[GridFit]) -> GridFit:
    """Choose the fit with which photos ``[h,w,3]`` match the pictures of their views best; of equal fits the first."""
    views = [view for view, photo in enumerate(photos) if photo is not None]

    def score(fit: GridFit) -> np.ndarray:
        return np.concatenate([
            correlate_parts(shown, view, fit.cut(photos[view]))  # type: ignore[arg-type]
            for view in views
        ])  # fmt: skip

    best, best_scores = fits[0], score(fits[0])
    for fit in fits[1:]:
        scores = score(fit)
        if stands_out(scores - best_scores):
            best, best_scores = fit, scores
    return best
