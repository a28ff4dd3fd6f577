"""Choose the part of photos that views show, or how a model resized photos to the grid of a file's rows.

If a file has no cameras, its model may have cropped the photos or changed their aspect ratio, and may have cut borders
off its output. :func:`choose_fit` takes the part or the resizing by which photos best match the pictures of the
Gaussians; :mod:`gsmerge.reading.photos.photo_parts` lists the parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import TypeVar

import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.photo_files import (
    WHOLE,
    Part,
    PhotoTransform,
    Size,
    cut_part,
    part_size,
    reaches_beyond,
    resize_and_crop,
    resize_to,
)
from gsmerge.method.compare.offsets import correlate_parts
from gsmerge.method.compare.similarity import stands_out
from gsmerge.method.compare.view_pictures import ViewPictures
from gsmerge.reading.alignment import TRIMS


@dataclass(frozen=True)
class PartFit:
    """The part of each photo that its view shows."""

    part: Part = WHOLE
    # The part is stretched to the aspect ratio of the size ``shape``, because stereo films squeeze pictures; None: not
    # stretched
    shape: Size | None = None

    def cut(self, photo: np.ndarray) -> np.ndarray:
        """Cut the part out of an upright photo ``[h,w,3]``, and stretch it."""
        part = cut_part(photo, self.part)
        size = part.shape[1::-1]
        new_size = self.stretch(part.shape[1::-1])
        return part if size == new_size else resize_to(size, new_size).photos([part])[0]

    def stretch(self, size: Size) -> Size:
        """Return the size to which a part of a ``size`` is stretched; the same size if parts are not stretched."""
        if self.shape is None:
            return size
        scale = max(size[0] / self.shape[0], size[1] / self.shape[1])
        return round(scale * self.shape[0]), round(scale * self.shape[1])

    def describe(self, size: Size, *, bars: bool) -> str:
        """Return a note on which part of photos of a ``size`` is used; with ``bars``, only bars are cut off."""
        photo_text = "{} x {}".format(*size)
        part = part_size(size, self.part)
        if reaches_beyond(self.part):
            place = f"from column {-round(size[0] * self.part[0])} and line {-round(size[1] * self.part[1])} on"
            whole = "{} x {}".format(*part)
            return f"photos of {photo_text} are put into pictures of {whole} {place}, since they are crops of the views"
        part_text = "{} x {}".format(*part)
        if bars:
            return f"bars around the photos are cut off: {photo_text} pixels become {part_text}"
        corner = f" from column {round(size[0] * self.part[0])} and line {round(size[1] * self.part[1])} on"
        stretched = ", stretched to {} x {}".format(*self.stretch(part)) if self.shape else ""
        part_name = "photos" if self.part == WHOLE else f"the {part_text} pixels{corner} of photos"
        used = f"{part_name} of {photo_text} are used{stretched}"
        return f"{used}, since they fit the Gaussians best"


WHOLE_FIT = PartFit()


def clear_beyond(weights: np.ndarray, part: Part) -> None:
    """Set the weights ``[h,w]`` of a part's pixels to 0 where the part reaches beyond its photo."""
    left, top, right, bottom = part
    height, width = weights.shape
    weights[: max(0, round(height * top / (top - bottom)))] = 0
    weights[max(0, round(height * (1 - top) / (bottom - top))) :] = 0
    weights[:, : max(0, round(width * left / (left - right)))] = 0
    weights[:, max(0, round(width * (1 - left) / (right - left))) :] = 0


@dataclass(frozen=True)
class GridFit:
    """How a model resized and cropped photos to a grid; the Gaussians of its pixels are the rows of a file."""

    size: Size  # size of the grid
    crops: bool = False  # True: resized in proportion and cropped at the centre; False: resized without proportion
    trim: tuple[int, int] = (0, 0)  # columns and lines that the model cut off its output at each side

    def transform(self, size: Size) -> PhotoTransform:
        """Return the transform of photos of a ``size`` to the grid before the model cut off borders."""
        width, height = (side + 2 * cut for side, cut in zip(self.size, self.trim, strict=True))
        return (resize_and_crop if self.crops else resize_to)(size, (width, height))

    def cut(self, photo: np.ndarray) -> np.ndarray:
        """Resize and crop a photo ``[h,w,3]`` of any size to the pixels of the grid.

        If only the photo or only the grid is portrait, the photo is turned first, and the result is turned back.
        """
        width, height = self.size
        left, top = self.trim
        if (photo.shape[1] - photo.shape[0]) * (width - height) < 0:
            return np.rot90(self.cut(np.ascontiguousarray(np.rot90(photo))), -1)
        whole = self.transform((photo.shape[1], photo.shape[0])).photos([photo])[0]
        return np.asarray(whole[top : top + height, left : left + width])

    def cameras(self, camera_file: CameraFile, size: Size) -> CameraFile:
        """Return the cameras of the grid as they were before the model cut off borders.

        The ``photo_map`` of these cameras is the transform of photos of a ``size``.
        """
        left, top = self.trim
        width, height = self.size
        Ks = camera_file.Ks.copy()
        assert camera_file.pixel_ids is not None, "estimated cameras are those of pixels"
        Ks[:, :2, 2] += self.trim
        widths = camera_file.widths + 2 * left
        heights = camera_file.heights + 2 * top
        lines, x = np.divmod(camera_file.pixel_ids, width)
        views, y = np.divmod(lines, height)
        pixel_ids = (views * (height + 2 * top) + y + top) * (width + 2 * left) + x + left
        pixel_ids = np.where(lines >= 0, pixel_ids, -1)
        photo_map = size, self.transform(size)
        return replace(camera_file, Ks=Ks, widths=widths, heights=heights, pixel_ids=pixel_ids, photo_map=photo_map)


def _da3_borders(side: int) -> list[int]:
    """List how many pixels Depth Anything 3 may have cut off at each end of a side of which ``side`` pixels are left.

    Depth Anything 3 cuts off 8 of 256 pixels, rounded down.
    """
    return [border for border in range(side) if int(8 / 256 * (side + 2 * border)) == border]


FitT = TypeVar("FitT", bound=GridFit | PartFit)


def list_fits(size: Size) -> list[GridFit]:
    """List the ways in which models resize and crop photos to a grid of a ``size``, simple ones first."""
    trims = [(trim, trim) for trim in (0, *TRIMS)]
    trims += product(_da3_borders(size[0]), _da3_borders(size[1]))
    return [GridFit(size, crops, trim) for crops in (False, True) for trim in dict.fromkeys(trims)]


def choose_fit(shown: ViewPictures, photos: Sequence[np.ndarray | None], fits: Sequence[FitT]) -> FitT:
    """Choose the fit with which photos ``[h,w,3]`` match the pictures of their views best.

    A later fit is chosen only if it matches significantly better than the best of the earlier fits.
    """
    views = [view for view, photo in enumerate(photos) if photo is not None]

    def correlate(fit: FitT) -> np.ndarray:
        """Return the correlations of all parts of all photos after a fit."""
        return np.concatenate([
            correlate_parts(shown, view, fit.cut(photos[view]))  # type: ignore[arg-type]
            for view in views
        ])  # fmt: skip

    best = fits[0]
    best_correlations = correlate(fits[0])
    for fit in fits[1:]:
        correlations = correlate(fit)
        if stands_out(correlations - best_correlations):
            best = fit
            best_correlations = correlations
    return best
