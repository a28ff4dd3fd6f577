"""The size of the Gaussian grid, where cameras, photos and grid may each have another."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from gsmerge.errors import SceneError
from gsmerge.io.alignment.layouts import PER_PIXEL, TRIM
from gsmerge.io.cameras.camera_file import CameraFile, sizes_of, to_cameras
from gsmerge.io.formats.ply import PlyInfo
from gsmerge.io.photos import ASPECT_TOLERANCE, PhotoTransform, Size, resize_and_crop, resize_to, same_shape
from gsmerge.types import Cameras

PATCH = 14  # sides of vision transformers' inputs are multiples of it
SIDES = (504, 518)  # to which Depth Anything 3 and others resize the longer or the shorter side, pixels
_ROUND = (8, PATCH)  # sides of grids that photos are cropped to are multiples of one of them
_MIN_KEPT = 0.5  # of a photo's area, when it is cropped
_MAX_ENLARGED = 1.5  # times the side of a photo; some networks enlarge small ones


@dataclass(frozen=True)
class GridFit:
    """One way to bring cameras and photos to the grid.

    Its rank is what speaks for it: a size that files have (0); the number of rows and the photos' shape (1); the number
    of rows alone (2); a network's usual sizes (3).
    """

    cameras: Cameras  # at the grid's size
    transform: PhotoTransform | None  # what is done to the photos, if anything
    notes: tuple[str, ...]  # what it is, for people
    rank: int = 0

    @property
    def size(self) -> Size:
        """(width, height) of the grid."""
        return self.cameras.width, self.cameras.height

    @property
    def guessed(self) -> bool:
        """Whether it is one of many that the number of rows allows."""
        return self.rank in (1, 2)


def photo_grid(camera_file: CameraFile, size: Size | None) -> GridFit:
    """The grid has the photos' size, or that of the cameras where there are no photos. SceneError if the cameras' size
    is not the photos' or a multiple of it.
    """
    if size is None:
        return GridFit(to_cameras(camera_file), None, ())
    width, height = size
    for w, h in sizes_of(camera_file):
        if not same_shape((w, h), size):
            problem = f"expected cameras of the images' size {width} x {height} or a multiple of it, found {w} x {h}"
            swapped = (w, h) == (height, width)
            remedy = "width and height are swapped" if swapped else "crop cameras and images alike"
            raise SceneError(camera_file.path, problem, remedy)
    other = [s for s in sizes_of(camera_file) if s != size]
    notes = tuple(f"intrinsics scaled from {w} x {h} to the images' {width} x {height}" for w, h in other)
    return GridFit(to_cameras(camera_file, size), None, notes)


def other_grids(ply: PlyInfo, camera_file: CameraFile, size: Size | None) -> Iterator[GridFit]:
    """All other grids that the files and the number of rows allow, the likely ones first; ``size`` is the photos'."""
    known = sizes_of(camera_file)
    own = known[0] if len(known) == 1 else None
    if size is not None and own is not None and own != size:
        yield from _between(camera_file, size, own)
    base = size or own
    if base is None or any(not same_shape(s, base) for s in known):
        return
    cameras = to_cameras(camera_file, base)
    what = "photos and cameras" if size is not None else "cameras"
    ranked = [(2 if t.crops else 1, t) for t in grids_of_count(ply.count, len(camera_file), base)]
    if ply.sh_degree == 0 and ply.opacity_encoding == "logit":
        ranked += [(3, t) for t in patch_grids(base) if ply.count < len(camera_file) * t.width * t.height]
    for rank, transform in ranked:
        note = f"{what} of {base[0]} x {base[1]} are {transform.description}, the Gaussian grid's size"
        yield GridFit(transform.cameras(cameras), transform, (note,), rank)
        if not known and transform.crops:
            whole = to_cameras(camera_file, (transform.width, transform.height))
            yield GridFit(whole, transform, (f"{note}; the intrinsics are those of the result",), rank)


def _between(camera_file: CameraFile, size: Size, own: Size) -> Iterator[GridFit]:
    """Photos brought to the cameras' size, or cameras of uncropped pictures brought to the photos'."""
    cameras = to_cameras(camera_file, own)
    for transform in (resize_to(size, own), resize_and_crop(size, own)):
        if max(transform.scale_x, transform.scale_y) > _MAX_ENLARGED:
            continue  # previews: a fit to them would blur the Gaussians
        note = f"photos of {size[0]} x {size[1]} are {transform.description}, the cameras' and the Gaussian grid's size"
        yield GridFit(cameras, transform, (note,))
    if not same_shape(own, size):
        for transform in (resize_to(own, size), resize_and_crop(own, size)):
            note = f"cameras of {own[0]} x {own[1]} are {transform.description}, the images' size"
            yield GridFit(transform.cameras(cameras), None, (note,))


def grids_of_count(count: int, views: int, size: Size) -> Iterator[PhotoTransform]:
    """Transforms of photos to smaller grids that ``count`` rows allow, with as many for each of all ``views``."""
    crops: list[PhotoTransform] = []
    for trim in (0, TRIM):
        for per_pixel in PER_PIXEL:
            pixels, rest = divmod(count, views * per_pixel)
            if rest:
                continue
            for to in _sizes_of_area(pixels, trim, size):
                aspect = to[0] * size[1] / (to[1] * size[0])
                if abs(aspect - 1) <= ASPECT_TOLERANCE:
                    yield resize_to(size, to)
                is_round = to[0] == to[1] or any(to[0] % side == to[1] % side == 0 for side in _ROUND)
                if to[0] * to[1] < size[0] * size[1] and min(aspect, 1 / aspect) >= _MIN_KEPT and is_round:
                    crops.append(resize_and_crop(size, to))
    yield from (crop for crop in crops if crop.crops)


def _sizes_of_area(pixels: int, trim: int, size: Size) -> Iterator[Size]:
    """Sizes up to ``size`` that leave as many pixels when ``trim`` is cut off at every border."""
    for width in range(max(1, pixels // size[1]), min(size[0], pixels) + 1):
        height, rest = divmod(pixels, width)
        to = width + 2 * trim, height + 2 * trim
        if not rest and to != size and to[0] <= size[0] and to[1] <= size[1]:
            yield to


def patch_grids(size: Size) -> list[PhotoTransform]:
    """Transforms of networks that take multiples of 14: each side to the nearest one, or cropped to it."""
    transforms = []
    for side in SIDES:
        for scale in (side / max(size), side / min(size)):
            if scale <= 1:
                width, height = (PATCH * max(1, round(s * scale / PATCH)) for s in size)
                transforms.append(resize_to(size, (width, height)))
                width, height = (PATCH * max(1, round(s * scale) // PATCH) for s in size)
                transforms.append(resize_and_crop(size, (width, height), scale))
    return list(dict.fromkeys(transforms))


def small_photos_error(ply: PlyInfo, camera_file: CameraFile, size: Size | None) -> SceneError | None:
    """Why photos do not do where the rows are as many as the cameras have pixels, but of another size."""
    own = next((s for s in sizes_of(camera_file) if ply.count == len(camera_file) * s[0] * s[1]), None)
    if size is None or own is None or own == size:
        return None
    problem = f"expected images of the Gaussian grid's size {own[0]} x {own[1]} or larger, found {size[0]} x {size[1]}"
    return SceneError(camera_file.path, problem, "give the images that the backbone saw, or their originals")
