"""Bring cameras and photos to each size that the grid of the rows may have.

Files give some sizes, and the rows themselves show others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from gsmerge.alignment.cameras import Poses, describe_other_convention
from gsmerge.alignment.layouts import ESTIMATED, TRIMS, da3_box
from gsmerge.errors import SceneError
from gsmerge.geometry import IDENTITY, Similarity
from gsmerge.io.cameras.camera_file import PATCH, CameraFile, Convention, sizes_of, to_cameras
from gsmerge.io.cameras.table import FFGS
from gsmerge.io.formats.read import FileInfo
from gsmerge.io.photo_files import ASPECT_TOLERANCE, PhotoTransform, Size, resize_and_crop, resize_to, same_shape
from gsmerge.types import Cameras

SIDES = (504, 518)  # pixels to which Depth Anything 3 and others resize the longer or the shorter side
SQUARE = 256  # side of the images of pixelSplat and its relatives, pixels
_MULTIPLES = (8, PATCH)  # if photos are cropped, both sides of the grid are multiples of one of these
_STRETCHED, _MAX_STRETCH = 16, 0.15  # ReSplat stretches photos to multiples of 16 pixels, and by at most 15 %
_STRETCHES = 0.1  # relative difference of the scales of width and height above which few models resize photos
_MIN_CROP = 0.5  # smallest share of a photo's area that is left after cropping
_NEAR_SIZE = 0.05  # largest difference between assumed camera sizes and photo sizes, divided by the longer side
_MAX_ENLARGED = 1.5  # largest factor by which photos are enlarged; some networks enlarge small photos


@dataclass(frozen=True, eq=False)
class Grid:
    """The cameras and the photo transform for one size of the pixel grid."""

    camera_file: CameraFile  # the cameras as they are read, in one convention of the poses
    cameras: Cameras  # the same cameras at the size of the grid
    transform: PhotoTransform | None  # applied to the photos; None: nothing
    notes: tuple[str, ...]  # notes for the user, one sentence each
    moves: Sequence[dict[str, Any]] = ()  # how far each camera was moved to its Gaussians; empty if none was moved
    given: np.ndarray | None = None  # ``[c,4,4]`` given poses that the photos confirm; Gaussians move there
    left_out: tuple[str, ...] = ()  # notes on views and cameras that do not fit each other

    @property
    def size(self) -> Size:
        """(width, height) of the grid, pixels."""
        return self.cameras.width, self.cameras.height


@dataclass(frozen=True)
class PlacedGrid:
    """Cameras that show Gaussians in place: the cameras of a grid, moved into the frame of the Gaussians."""

    grid: Grid
    frame: Similarity
    shown_by: str = ""  # evidence for the frame, in words; empty for a frame that a file gives

    @property
    def cameras(self) -> Cameras:
        """The cameras in the frame of the Gaussians."""
        return self.grid.cameras if self.frame is IDENTITY else self.frame.move(self.grid.cameras)

    def notes(self, usual: Convention) -> list[str]:
        """List notes on what was adapted; ``usual`` is the convention of the poses' format."""
        notes, convention = [*self.grid.notes], self.grid.camera_file.convention
        if convention != usual:
            notes.append(f"{describe_other_convention(convention, usual)}: read so")
        if self.frame is not IDENTITY:
            evidence = f", as the {self.shown_by} show" if self.shown_by else ""
            notes.append(f"the cameras are {self.frame.description}{evidence}")
        return notes


def with_poses(grid: Grid, poses: Poses) -> Grid:
    """Return a grid with the poses of its cameras in another convention."""
    file = replace(grid.camera_file, viewmats=poses.viewmats, convention=poses.convention)
    return replace(grid, camera_file=file, cameras=replace(grid.cameras, viewmats=poses.viewmats))


def with_photo_size(camera_file: CameraFile, size: Size | None, tolerance: float = 1) -> CameraFile:
    """Give cameras the size of the photos if the cameras' own size differs by up to ``tolerance`` pixels.

    The own size may have been computed as twice the principal point. The same cameras are returned otherwise.
    """
    stored = sizes_of(camera_file)
    if size is None or len(stored) != 1 or not 0 < max(abs(np.subtract(stored[0], size))) <= tolerance:
        return camera_file
    widths, heights = (np.full_like(camera_file.widths, side) for side in size)
    return replace(camera_file, widths=widths, heights=heights)


def photo_grid(camera_file: CameraFile, size: Size | None) -> Grid:
    """Return the grid of the photos' size, or of the cameras' size without photos.

    Raises SceneError if the shapes of cameras and photos differ.
    """
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
    scaled = [camera_size for camera_size in sizes_of(camera_file) if camera_size != size]
    notes = tuple(f"intrinsics scaled from {w} x {h} to the images' {width} x {height}" for w, h in scaled)
    return Grid(camera_file, to_cameras(camera_file, size), None, notes)


def _mapped_grid(camera_file: CameraFile, size: Size, file_size: Size, transform: PhotoTransform) -> Grid:
    """Return the grid of photos that a known ``transform`` of ``file_size`` resizes or crops.

    ``size`` is the size of the photos in memory, which may be reduced from ``file_size``.
    """
    x, y = (file_side / side for file_side, side in zip(file_size, size, strict=True))
    transform = replace(transform, scale_x=x * transform.scale_x, scale_y=y * transform.scale_y)
    note = f"photos of {file_size[0]} x {file_size[1]} are {transform.description}, the Gaussian grid's size"
    if camera_file.source == ESTIMATED and abs(transform.scale_x / transform.scale_y - 1) > _STRETCHES:
        note += "; if the model did not squeeze them, rows were left out of the file: name its cameras with --cameras"
    is_same = file_size == (transform.width, transform.height)
    return Grid(camera_file, to_cameras(camera_file), transform, () if is_same else (note,))


def _are_stretched(camera_file: CameraFile, size: Size) -> bool:
    """Return True if the model has stretched the photos, so that oblong pixels become square at the photos' size."""
    if camera_file.focal is None:
        return False
    focals = camera_file.Ks[:, (0, 1), (0, 1)]
    sides = np.stack([camera_file.widths, camera_file.heights], 1)
    ratios = np.divide(*(focals * size / np.maximum(sides, 1)).T)
    return bool((np.abs(ratios - 1) <= ASPECT_TOLERANCE).all())


def file_grids(camera_file: CameraFile, size: Size | None) -> list[Grid]:
    """List the grids of photos brought to the size of the cameras, or of cameras cropped to the size of the photos.

    ``size`` is the size of the photos. Empty without photos, and if cameras and photos have the same size.
    """
    sizes = sizes_of(camera_file)
    if size is None or len(sizes) != 1 or sizes[0] == size or camera_file.photo_map is not None:
        return []
    (camera_size,), grids = sizes, []
    cameras = to_cameras(camera_file, camera_size)
    for transform in (resize_to(size, camera_size), resize_and_crop(size, camera_size)):
        if max(transform.scale_x, transform.scale_y) > _MAX_ENLARGED:
            continue  # the photos are previews, and a fit to them would blur the Gaussians
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
    """List the grids to which ``transforms(size)`` bring the photos, or without photos the cameras.

    ``size`` is the size of the photos. Empty if cameras have several sizes, or another shape than the photos.
    """
    sizes = sizes_of(camera_file)
    base = size or (sizes[0] if len(sizes) == 1 else None)
    if base is None or any(not same_shape(s, base) for s in sizes):
        return []
    at_photo_size = with_photo_size(camera_file, base, _NEAR_SIZE * max(base))
    files = [camera_file] if at_photo_size is camera_file else [camera_file, at_photo_size]
    subject = "photos and cameras" if size is not None else "cameras"
    grids: list[Grid] = []
    for transform in transforms(base):
        note = f"{subject} of {base[0]} x {base[1]} are {transform.description}, the Gaussian grid's size"
        grids += [Grid(file, transform.cameras(to_cameras(file, base)), transform, (note,)) for file in files]
        if not sizes and transform.crops:
            cameras = to_cameras(camera_file, (transform.width, transform.height))
            grids.append(Grid(camera_file, cameras, transform, (f"{note}; the intrinsics are those of the result",)))
    return grids


def shown_sizes(size: Size, shape: Size) -> list[PhotoTransform]:
    """List the transforms that shrink photos of a ``size`` to a grid whose borders may have been cut off.

    ``shape`` is (width, height) of the rows, the grid without its borders.
    """
    transforms = []
    for trim in (0, *TRIMS):
        grid_size = width, height = shape[0] + 2 * trim, shape[1] + 2 * trim
        if grid_size == size or width > size[0] or height > size[1]:
            continue
        aspect = width * size[1] / (height * size[0])
        is_usual = width == height or any(width % side == height % side == 0 for side in _MULTIPLES)
        may_stretch = abs(aspect - 1) <= _MAX_STRETCH and width % _STRETCHED == height % _STRETCHED == 0
        may_crop = min(aspect, 1 / aspect) >= _MIN_CROP and is_usual
        if abs(aspect - 1) <= ASPECT_TOLERANCE or (may_crop and may_stretch):
            transforms.append(resize_to(size, grid_size))
        if may_crop:
            transforms.append(resize_and_crop(size, grid_size))
    for transform in (*(resize_to(size, half) for half in _half_sizes(size)), *patch_grids(size)):
        width, height = transform.width, transform.height
        if da3_box(width, height).pixels(width, height).shape == shape[::-1]:
            transforms.append(transform)
    return list(dict.fromkeys(transforms))


def network_sizes(size: Size) -> list[PhotoTransform]:
    """List the transforms of networks to grids whose rows may lack some pixels."""
    return [*patch_grids(size), *(resize_to(size, half) for half in _half_sizes(size)), *square_sizes(size)]


def square_sizes(size: Size) -> list[PhotoTransform]:
    """List the transform that crops photos to the square of pixelSplat and similar models; empty for smaller photos."""
    square = SQUARE, SQUARE
    return [resize_and_crop(size, square)] if min(size) >= SQUARE and size != square else []


def _half_sizes(size: Size) -> Iterator[Size]:
    """Yield the sizes at which Lyra 2 writes Gaussians: half of each side, maybe rounded to a multiple of 14 first."""
    yield from product(*({side // 2, PATCH * round(side / PATCH) // 2} - {0} for side in size))


def patch_grids(size: Size) -> list[PhotoTransform]:
    """List the transforms of networks that take multiples of 14 pixels: each side is rounded, or cropped."""
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
    """Make the SceneError for rows that fill a grid of the cameras' size, while the photos have another size.

    None for other numbers of rows and for photos of the cameras' size.
    """
    grid_size = next((s for s in sizes_of(camera_file) if ply.count == len(camera_file) * s[0] * s[1]), None)
    if size is None or grid_size is None or grid_size == size:
        return None
    problem = f"expected images of the Gaussian grid's size {grid_size[0]} x {grid_size[1]} or larger"
    problem += f", found {size[0]} x {size[1]}"
    return SceneError(camera_file.path, problem, "give the images that the backbone saw, or their originals")
