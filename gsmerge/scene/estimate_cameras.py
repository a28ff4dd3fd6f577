"""Estimate the cameras of rows whose file has none, or poses alone, and how photos were brought to their grid.

Photos of any size are compared with the views of a grid, whose pictures are its rows' own colours: models squeeze or
crop photos, and some cut a border off what they write.
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
        reason = "no focal length fits the Gaussians" if len(photos) else "no photos that show them"
        raise missing_intrinsics(camera_file.path, f", and {reason}")
    return estimated


def estimate_cameras(ply: GaussianFile, path: Path, folder: Path | None) -> CameraFile | None:
    """Estimate cameras of the photos in a folder, or those of a grid of any size; None for other rows."""
    cameras, paths = None, [] if folder is None else list_images(folder)
    if folder is not None and paths:
        names = [photo.relative_to(folder).as_posix() for photo in paths]
        with suppress(SceneError):  # what is no image has no size
            size = image_size(paths[0])  # as it is stored, or turned
            cameras = alignment.estimate_cameras(path, ply.gaussians, ply.valid, names, size, size[::-1])
    return cameras or alignment.estimate_from_rows(path, ply.gaussians, ply.valid)


@dataclass(frozen=True)
class GridFit:
    """How photos were brought to the pixels of a grid of rows."""

    size: Size  # of the grid
    crops: bool = False  # whether their middle was cut out, and not the whole squeezed
    trim: tuple[int, int] = (0, 0)  # columns and lines at both sides that the grid lacks

    def transform(self, size: Size) -> PhotoTransform:
        """Return the transform of photos of a size to the grid with its borders."""
        width, height = (side + 2 * cut for side, cut in zip(self.size, self.trim, strict=True))
        return (resize_and_crop if self.crops else resize_to)(size, (width, height))

    def cut(self, photo: np.ndarray) -> np.ndarray:
        """Bring a photo ``[h,w,3]`` of any size to the pixels of the grid; one that lies where this stands stays so."""
        (width, height), (x, y) = self.size, self.trim
        if (photo.shape[1] - photo.shape[0]) * (width - height) < 0:
            return np.rot90(self.cut(np.ascontiguousarray(np.rot90(photo))), -1)
        whole = self.transform((photo.shape[1], photo.shape[0])).photos([photo])[0]
        return np.asarray(whole[y : y + height, x : x + width])

    def cameras(self, camera_file: CameraFile, size: Size) -> CameraFile:
        """Return cameras of the grid with its borders, and how photos of a size are brought there."""
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
    """List the ways in which models bring photos to a grid of a size, simple ones first."""
    trims = [(trim, trim) for trim in (0, *alignment.TRIMS)]
    trims += product(alignment.da3_borders(size[0]), alignment.da3_borders(size[1]))
    return [GridFit(size, crops, trim) for crops in (False, True) for trim in dict.fromkeys(trims)]


def choose_fit(shown: ViewPictures, photos: Sequence[np.ndarray | None], fits: Sequence[GridFit]) -> GridFit:
    """Choose how photos ``[h,w,3]`` that show the views were brought to their grid: of equals the first."""
    views = [view for view, photo in enumerate(photos) if photo is not None]

    def score(fit: GridFit) -> np.ndarray:
        parts = [correlate_parts(shown, view, fit.cut(photos[view])) for view in views]  # type: ignore[arg-type]
        return np.concatenate(parts)

    best, most = fits[0], score(fits[0])
    for fit in fits[1:]:
        scores = score(fit)
        if stands_out(scores - most):
            best, most = fit, scores
    return best
