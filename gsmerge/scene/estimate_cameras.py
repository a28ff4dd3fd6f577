"""Estimate cameras for rows that have none or only poses, and find how photos were resized to the rows' grid.

Models resize photos without their aspect ratio or crop them, and some cut a border off their output. Therefore photos
of any size are compared with the pictures of a grid, which are the colours of its rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from gsmerge import alignment
from gsmerge.errors import SceneError
from gsmerge.evidence.offsets import correlate_parts
from gsmerge.evidence.pictures import ViewPictures
from gsmerge.evidence.scores import stands_out
from gsmerge.io.cameras.camera_file import CameraFile, missing_intrinsics
from gsmerge.io.formats.read import GaussianFile
from gsmerge.io.image_names import list_images
from gsmerge.io.photo_files import PhotoArrays, PhotoTransform, Size, image_size, resize_and_crop, resize_to


def estimate_focal(ply: GaussianFile, camera_file: CameraFile, photos: PhotoArrays) -> CameraFile:
    """Estimate the focal length of cameras whose file has poses alone; SceneError if that fails."""
    estimated = alignment.estimate_focal(ply, camera_file, photos)
    if estimated is None:
        reason = "no focal length fits the Gaussians" if len(photos) else "no photos to estimate them from"
        raise missing_intrinsics(camera_file.path, f", and {reason}")
    return estimated


def estimate_cameras(ply: GaussianFile, path: Path, folder: Path | None) -> CameraFile | None:
    """Estimate the cameras of the photos in a folder, or else of a grid of any size; None if the rows are no grid."""
    cameras, paths = None, [] if folder is None else list_images(folder)
    if folder is not None and paths:
        names = [photo.relative_to(folder).as_posix() for photo in paths]
        with suppress(SceneError):  # the first file may be no image
            size = image_size(paths[0])
            turned = size[::-1]  # by its orientation tag
            cameras = alignment.estimate_cameras(path, ply.gaussians, ply.valid, names, size, turned)
    return cameras or alignment.estimate_from_rows(path, ply.gaussians, ply.valid)


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
        (x, y), Ks, pixel_ids = self.trim, camera_file.Ks.copy(), camera_file.pixel_ids
        Ks[:, :2, 2] += self.trim
        if pixel_ids is not None:
            layout = alignment.dropped_layout(pixel_ids, len(camera_file), *self.size)
            wider = alignment.move_layout(layout, self.size[0] + 2 * x, self.size[1] + 2 * y, x, y)
            pixel_ids = wider.pixel_ids(len(pixel_ids))
        widths, heights = camera_file.widths + 2 * x, camera_file.heights + 2 * y
        photo_map = size, self.transform(size)
        return replace(camera_file, Ks=Ks, widths=widths, heights=heights, pixel_ids=pixel_ids, photo_map=photo_map)


def list_fits(size: Size) -> list[GridFit]:
    """List how models resize and crop photos to a grid of a size, simple fits first."""
    trims = [(trim, trim) for trim in (0, *alignment.TRIMS)]
    trims += product(alignment.da3_borders(size[0]), alignment.da3_borders(size[1]))
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
