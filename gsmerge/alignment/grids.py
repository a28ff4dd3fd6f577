"""Find the cameras and photos of a size that the grid of the rows may have: one that files name, or that rows show."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from gsmerge.alignment.cameras import Poses, describe_reading
from gsmerge.alignment.layouts import TRIMS, da3_box
from gsmerge.errors import SceneError
from gsmerge.geometry import IDENTITY, Similarity
from gsmerge.io.cameras.camera_file import PATCH, CameraFile, Convention, sizes_of, to_cameras
from gsmerge.io.cameras.table import FFGS
from gsmerge.io.formats.read import FileInfo
from gsmerge.io.photo_files import ASPECT_TOLERANCE, PhotoTransform, Size, resize_and_crop, resize_to, same_shape
from gsmerge.types import Cameras

SIDES = (504, 518)  # to which Depth Anything 3 and others resize the longer or the shorter side, pixels
SQUARE = 256  # side of the pictures of pixelSplat and its relatives, pixels
_ROUND = (8, PATCH)  # sides of grids that photos are cropped to are multiples of one of them
_STRETCHED, _MAX_STRETCH = 16, 0.15  # multiples of its sides, to which ReSplat stretches photos, and by how much
_MIN_KEPT = 0.5  # of a photo's area, when it is cropped
_NEAR_SIZE = 0.05  # of the longer side, by which cameras' sizes may differ that are no more than assumed
_MAX_ENLARGED = 1.5  # times the side of a photo; some networks enlarge small ones


@dataclass(frozen=True)
class Grid:
    """The cameras and the photo transform for one size of the pixel grid."""

    camera_file: CameraFile  # the cameras as they are read, in one convention of the poses
    cameras: Cameras  # the same at the grid's size
    transform: PhotoTransform | None  # what is done to the photos, if anything
    notes: tuple[str, ...]  # what it is, for people
    moves: Sequence[dict[str, Any]] = ()  # how far each camera was moved to its Gaussians; empty where none was
    given: np.ndarray | None = None  # ``[c,4,4]`` poses that the photos confirm, to which Gaussians are to be moved

    @property
    def size(self) -> Size:
        """(width, height) of the grid, pixels."""
        return self.cameras.width, self.cameras.height


@dataclass(frozen=True)
class Place:
    """Cameras that show Gaussians in their place: those of a grid, moved into a frame."""

    grid: Grid
    frame: Similarity
    shown_by: str = ""  # what shows the frame, for people; empty for one that a file names

    @property
    def cameras(self) -> Cameras:
        """The cameras in the frame of the Gaussians."""
        return self.grid.cameras if self.frame is IDENTITY else self.frame.move(self.grid.cameras)

    def notes(self, usual: Convention) -> list[str]:
        """List what was adapted, for people; ``usual``: the convention of the poses' format."""
        notes, convention = [*self.grid.notes], self.grid.camera_file.convention
        if convention != usual:
            notes.append(f"{describe_reading(convention, usual)}: read so")
        if self.frame is not IDENTITY:
            why = f", as the {self.shown_by} show" if self.shown_by else ""
            notes.append(f"the cameras are {self.frame.description}{why}")
        return notes


def read_as(grid: Grid, poses: Poses) -> Grid:
    """Return a grid with the poses of its cameras read in another convention."""
    file = replace(grid.camera_file, viewmats=poses.viewmats, convention=poses.convention)
    return replace(grid, camera_file=file, cameras=replace(grid.cameras, viewmats=poses.viewmats))


def with_photo_size(camera_file: CameraFile, size: Size | None, most: float = 1) -> CameraFile:
    """Return the cameras with the photos' size if theirs is up to ``most`` pixels off, as twice a principal point is.

    The same cameras where it is not.
    """
    stored = sizes_of(camera_file)
    if size is None or len(stored) != 1 or not 0 < max(abs(np.subtract(stored[0], size))) <= most:
        return camera_file
    widths, heights = (np.full_like(camera_file.widths, side) for side in size)
    return replace(camera_file, widths=widths, heights=heights)


def photo_grid(camera_file: CameraFile, size: Size | None) -> Grid:
    """Return the grid of the photos' size, or of the cameras' size without photos; SceneError if the two disagree."""
    if size is None:
        return Grid(camera_file, to_cameras(camera_file), None, ())
    if camera_file.photo_map is not None:
        return _mapped_grid(camera_file, size, *camera_file.photo_map)
    width, height = size
    for w, h in sizes_of(camera_file):
        if not same_shape((w, h), size) and not _are_stretched(camera_file, size):
            if camera_file.source == FFGS:
                return _mapped_grid(camera_file, size, size, resize_and_crop(size, (w, h)))
            problem = f"expected cameras of the images' size {width} x {height} or a multiple of it, found {w} x {h}"
            swapped = (w, h) == (height, width)
            remedy = "width and height are swapped" if swapped else "crop cameras and images alike"
            raise SceneError(camera_file.path, problem, remedy)
    other = [s for s in sizes_of(camera_file) if s != size]
    notes = tuple(f"intrinsics scaled from {w} x {h} to the images' {width} x {height}" for w, h in other)
    return Grid(camera_file, to_cameras(camera_file, size), None, notes)


def _mapped_grid(camera_file: CameraFile, size: Size, file_size: Size, transform: PhotoTransform) -> Grid:
    """Return the grid of photos that were resized or cropped by a known transform; ``size``: in memory."""
    x, y = (whole / part for whole, part in zip(file_size, size, strict=True))
    transform = replace(transform, scale_x=x * transform.scale_x, scale_y=y * transform.scale_y)
    note = f"photos of {file_size[0]} x {file_size[1]} are {transform.description}, the Gaussian grid's size"
    is_same = file_size == (transform.width, transform.height)
    return Grid(camera_file, to_cameras(camera_file), transform, () if is_same else (note,))


def _are_stretched(camera_file: CameraFile, size: Size) -> bool:
    """Return whether oblong pixels become square at the size of the photos, which means that a model stretched them."""
    if camera_file.focal is None:
        return False
    focals = camera_file.Ks[:, (0, 1), (0, 1)]
    sides = np.stack([camera_file.widths, camera_file.heights], 1)
    ratios = np.divide(*(focals * size / np.maximum(sides, 1)).T)
    return bool((np.abs(ratios - 1) <= ASPECT_TOLERANCE).all())


def file_grids(camera_file: CameraFile, size: Size | None) -> list[Grid]:
    """List the grids of photos resized to the size of the cameras, or of cameras cropped as the photos were.

    ``size``: size of the photos. Empty without photos, and where both have one size.
    """
    sizes = sizes_of(camera_file)
    if size is None or len(sizes) != 1 or sizes[0] == size or camera_file.photo_map is not None:
        return []
    (camera_size,), grids = sizes, []
    cameras = to_cameras(camera_file, camera_size)
    for transform in (resize_to(size, camera_size), resize_and_crop(size, camera_size)):
        if max(transform.scale_x, transform.scale_y) > _MAX_ENLARGED:
            continue  # previews: a fit to them would blur the Gaussians
        note = f"photos of {size[0]} x {size[1]} are {transform.description}, the cameras' and the Gaussian grid's size"
        grids.append(Grid(camera_file, cameras, transform, (note,)))
    if not same_shape(camera_size, size):
        for transform in (resize_to(camera_size, size), resize_and_crop(camera_size, size)):
            note = f"cameras of {camera_size[0]} x {camera_size[1]} are {transform.description}, the images' size"
            grids.append(Grid(camera_file, transform.cameras(cameras), None, (note,)))
    return grids


def grids_of(
    camera_file: CameraFile, size: Size | None, transforms: Callable[[Size], list[PhotoTransform]]
) -> list[Grid]:
    """List the grids to which ``transforms`` bring the photos, or without photos the cameras.

    ``size``: size of the photos. Empty where cameras have several sizes, or another shape than the photos.
    """
    sizes = sizes_of(camera_file)
    base = size or (sizes[0] if len(sizes) == 1 else None)
    if base is None or any(not same_shape(s, base) for s in sizes):
        return []
    near = with_photo_size(camera_file, base, _NEAR_SIZE * max(base))
    files = [camera_file] + [near] * (near is not camera_file)
    what = "photos and cameras" if size is not None else "cameras"
    grids: list[Grid] = []
    for transform in transforms(base):
        note = f"{what} of {base[0]} x {base[1]} are {transform.description}, the Gaussian grid's size"
        grids += [Grid(file, transform.cameras(to_cameras(file, base)), transform, (note,)) for file in files]
        if not sizes and transform.crops:
            cameras = to_cameras(camera_file, (transform.width, transform.height))
            grids.append(Grid(camera_file, cameras, transform, (f"{note}; the intrinsics are those of the result",)))
    return grids


def shown_sizes(size: Size, shape: Size) -> list[PhotoTransform]:
    """List the transforms that shrink photos to grids of which rows of a ``shape`` are all pixels but for borders."""
    transforms = []
    for trim in (0, *TRIMS):
        to = shape[0] + 2 * trim, shape[1] + 2 * trim
        if to == size or to[0] > size[0] or to[1] > size[1]:
            continue
        aspect = to[0] * size[1] / (to[1] * size[0])
        is_round = to[0] == to[1] or any(to[0] % side == to[1] % side == 0 for side in _ROUND)
        stretched = abs(aspect - 1) <= _MAX_STRETCH and to[0] % _STRETCHED == to[1] % _STRETCHED == 0
        cropped = min(aspect, 1 / aspect) >= _MIN_KEPT and is_round
        transforms += [resize_to(size, to)] * (abs(aspect - 1) <= ASPECT_TOLERANCE or (cropped and stretched))
        transforms += [resize_and_crop(size, to)] * cropped
    for transform in (*(resize_to(size, half) for half in _half_sizes(size)), *patch_grids(size)):
        to = transform.width, transform.height
        transforms += [transform] * (da3_box(*to).pixels(*to).shape == shape[::-1])
    return list(dict.fromkeys(transforms))


def network_sizes(size: Size) -> list[PhotoTransform]:
    """List the transforms of networks to grids that rows may be of which lack pixels."""
    return [*patch_grids(size), *(resize_to(size, half) for half in _half_sizes(size)), *square_sizes(size)]


def square_sizes(size: Size) -> list[PhotoTransform]:
    """List the transform to the square to which pixelSplat and similar models crop photos, where that is smaller."""
    square = SQUARE, SQUARE
    return [resize_and_crop(size, square)] if min(size) >= SQUARE and size != square else []


def _half_sizes(size: Size) -> Iterator[Size]:
    """Yield the sizes at which Lyra 2 writes Gaussians: half the photos', or half of these as multiples of 14."""
    yield from product(*({side // 2, PATCH * round(side / PATCH) // 2} for side in size))


def patch_grids(size: Size) -> list[PhotoTransform]:
    """List the transforms of networks that take multiples of 14: each side rounded, or cropped, to a multiple."""
    transforms = []
    for side in SIDES:
        for scale in (side / max(size), side / min(size)):
            if scale <= 1:
                width, height = (PATCH * max(1, round(s * scale / PATCH)) for s in size)
                transforms.append(resize_to(size, (width, height)))
                width, height = (PATCH * max(1, round(s * scale) // PATCH) for s in size)
                transforms.append(resize_and_crop(size, (width, height), scale))
    return list(dict.fromkeys(transforms))


def small_photos_error(ply: FileInfo, camera_file: CameraFile, size: Size | None) -> SceneError | None:
    """Return the error for photos smaller than a pixel grid of the cameras' size; None for other photos."""
    grid_size = next((s for s in sizes_of(camera_file) if ply.count == len(camera_file) * s[0] * s[1]), None)
    if size is None or grid_size is None or grid_size == size:
        return None
    problem = f"expected images of the Gaussian grid's size {grid_size[0]} x {grid_size[1]} or larger"
    problem += f", found {size[0]} x {size[1]}"
    return SceneError(camera_file.path, problem, "give the images that the backbone saw, or their originals")
