"""Estimate the cameras of rows whose file has none, or poses alone, and find the photos that show them.

Photos of any size are matched with the views of a grid, whose pictures are its rows' own colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np

from gsmerge import alignment
from gsmerge.geometry import correlation
from gsmerge.io.cameras.camera_file import CameraFile, missing_intrinsics
from gsmerge.io.formats.read import GaussianFile
from gsmerge.io.image_names import list_images
from gsmerge.io.photo_files import Photos, PhotoTransform, Size, decode_image, image_size, resize_and_crop, resize_to
from gsmerge.runtime.threads import parallel_map

_SIDE = 128  # pixels of the pictures' longer side that are compared
_MAX_PHOTOS = 100  # that are looked at
_MIN_ALIKE, _MIN_ALIKE_EACH = 0.7, 0.4  # correlation of greys with the views' on average, and in each
_CLEARLY = 0.02  # by which other photos must be more alike than those in order


def estimate_focal(ply: GaussianFile, camera_file: CameraFile, photos: Photos) -> CameraFile:
    """Estimate the focal length of cameras whose file has poses alone; SceneError if that fails."""
    estimated = alignment.estimate_focal(ply, camera_file, photos)
    if estimated is None:
        reason = "no focal length fits the Gaussians" if len(photos) else "no photos that show them"
        raise missing_intrinsics(camera_file.path, f", and {reason}")
    return estimated


def estimate_cameras(ply: GaussianFile, path: Path, folder: Path) -> CameraFile | None:
    """Estimate cameras of the photos in a folder, or of a grid that none of them shows; None for other rows."""
    paths = list_images(folder)
    size = image_size(paths[0]) if paths else (0, 0)
    names = [photo.relative_to(folder).as_posix() for photo in paths]
    cameras = alignment.estimate_cameras(path, ply.gaussians, ply.valid, names, *size)
    return estimate_grid(ply, path, paths, folder) if cameras is None else cameras


def estimate_grid(
    ply: GaussianFile, path: Path, paths: Sequence[Path] = (), folder: Path = Path()
) -> CameraFile | None:
    """Estimate the cameras of rows that are a grid, and find its photos among some of a folder; None for other rows."""
    grid = alignment.estimate_from_rows(path, ply.gaussians, ply.valid)
    if grid is None:
        return None
    cameras, pictures = grid
    match = match_photos(pictures, paths)
    if match is None:
        return cameras
    (x, y), Ks, pixel_ids = match.trim, cameras.Ks.copy(), cameras.pixel_ids
    Ks[:, :2, 2] += match.trim
    if pixel_ids is not None:
        views, height, width = pictures.shape[:3]
        layout = alignment.dropped_layout(pixel_ids, views, width, height)
        pixel_ids = alignment.move_layout(layout, width + 2 * x, height + 2 * y, x, y).pixel_ids(len(pixel_ids))
    return replace(
        cameras,
        Ks=Ks,
        widths=cameras.widths + 2 * x,
        heights=cameras.heights + 2 * y,
        pixel_ids=pixel_ids,
        names=tuple(paths[photo].relative_to(folder).as_posix() for photo in match.chosen),
        photo_map=(match.size, match.transform),
    )


@dataclass(frozen=True)
class PhotoMatch:
    """Photos that show the views of a grid."""

    chosen: list[int]  # their places among the photos, of each view
    size: Size  # of the photos
    transform: PhotoTransform  # from there to the size of the views
    trim: tuple[int, int]  # columns and lines at both sides of a view that the grid lacks


def match_photos(pictures: np.ndarray, paths: Sequence[Path]) -> PhotoMatch | None:
    """Choose the photos that show the ``pictures [v,h,w,3]`` of a grid; None if there are none."""
    views, height, width = pictures.shape[:3]
    if not views <= len(paths) <= _MAX_PHOTOS:
        return None
    sizes = [image_size(path) for path in paths]
    size = max(sizes, key=sizes.count)
    trims = [(trim, trim) for trim in (0, *alignment.TRIMS)]
    trims += product(alignment.da3_borders(width), alignment.da3_borders(height))
    fits = [
        (trim, transform)
        for trim in dict.fromkeys(trims)
        for transform in _transforms(size, width + 2 * trim[0], height + 2 * trim[1])
    ]
    fits.sort(key=lambda fit: bool(fit[1].crops))  # of those that show the same, the simple one
    ratio = _SIDE / max(width, height)
    small = max(1, round(width * ratio)), max(1, round(height * ratio))
    wanted = [_grey(picture, small) for picture in pictures]

    def compare(number: int) -> np.ndarray:
        """Return the correlations ``[t,v]`` of a photo under each transform with each view."""
        if sizes[number] != size:
            return np.full((len(fits), views), -1.0)
        photo = decode_image(paths[number], size)
        shown = ((trim, transform.photos([photo])[0]) for trim, transform in fits)
        greys = [_grey(picture[y : y + height, x : x + width], small) for (x, y), picture in shown]
        with np.errstate(invalid="ignore", divide="ignore"):  # pictures of one colour
            return np.nan_to_num([[correlation(grey, view) for view in wanted] for grey in greys])

    alike = np.stack(parallel_map(compare, range(len(paths))))
    in_order = [range(views)] * (len(paths) == views)
    choices = [(number, list(chosen)) for number in range(len(fits)) for chosen in in_order]
    choices += [(number, alike[:, number].argmax(0).tolist()) for number in range(len(fits))]
    options = [(alike[chosen, number, range(views)], number, chosen) for number, chosen in choices]
    options = [option for option in options if len(set(option[2])) == views]
    options = [option for option in options if option[0].mean() >= _MIN_ALIKE and option[0].min() >= _MIN_ALIKE_EACH]
    if not options:
        return None
    best = max(float(each.mean()) for each, _, _ in options)
    near = [option for option in options if option[2] == list(range(views)) and option[0].mean() > best - _CLEARLY]
    _, number, chosen = max(near or options, key=lambda option: round(float(option[0].mean()), 3))
    trim, transform = fits[number]
    return PhotoMatch(chosen, size, transform, trim)


def _transforms(size: Size, width: int, height: int) -> list[PhotoTransform]:
    """List the ways in which models bring photos to a size: squeezed, or cropped."""
    return list(dict.fromkeys((resize_to(size, (width, height)), resize_and_crop(size, (width, height)))))


def _grey(picture: np.ndarray, size: Size) -> np.ndarray:
    """Return the mean of the colours of a picture ``[h,w,3]`` at a smaller size, as one row."""
    return cv2.resize(picture.mean(2, dtype=np.float32), size, interpolation=cv2.INTER_AREA).reshape(-1)
