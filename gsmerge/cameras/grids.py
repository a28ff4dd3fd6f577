"""Bring cameras and photos to the size of the pixel grid, which is the size of the photos or of the cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsmerge.cameras.layouts import ESTIMATED
from gsmerge.cameras.poses import PosesInConvention, describe_convention
from gsmerge.errors import SceneError
from gsmerge.geometry.transforms import IDENTITY, Similarity
from gsmerge.io.cameras.camera_file import CameraFile, Convention, sizes_of, to_cameras
from gsmerge.io.cameras.table import FFGS
from gsmerge.io.photo_files import PhotoTransform, Size, resize_and_crop, resize_to, same_shape
from gsmerge.types import Cameras


@dataclass(frozen=True, eq=False)
class Grid:
    """The cameras and the photo transform for one size of the pixel grid."""

    camera_file: CameraFile  # the cameras as they are read, in one convention of the poses
    cameras: Cameras  # the same cameras at the size of the grid
    transform: PhotoTransform | None  # transform of the photos to the grid; None: photos stay as they are
    notes: tuple[str, ...]  # notes for the user, one sentence each
    moves: Sequence[dict[str, Any]] = ()  # how far each camera was moved to its Gaussians; empty if none was moved
    # ``[c,4,4]`` poses as read, if photos confirm them, so that the Gaussians have to move instead; otherwise None
    confirmed_viewmats: np.ndarray | None = None

    @property
    def size(self) -> Size:
        """Width and height of the grid, in pixels."""
        return self.cameras.width, self.cameras.height


@dataclass(frozen=True)
class PlacedGrid:
    """The cameras of a grid, moved into the frame of the Gaussians."""

    grid: Grid
    frame: Similarity  # from the cameras' own world to the frame of the Gaussians
    shown_by: str = ""  # evidence for the frame, in words; empty for a frame that a file gives

    @property
    def cameras(self) -> Cameras:
        """The cameras in the frame of the Gaussians."""
        return self.grid.cameras if self.frame is IDENTITY else self.frame.move_cameras(self.grid.cameras)

    def notes(self, usual: Convention) -> list[str]:
        """List notes on what was changed in the cameras. ``usual`` is the pose convention of the file's format."""
        notes, convention = [*self.grid.notes], self.grid.camera_file.convention
        if convention != usual:
            fits = f"the poses fit when read as {describe_convention(convention)}"
            notes.append(f"{fits}, where this format has {usual[0]} with {usual[1]} axes: read so")
        if self.frame is not IDENTITY:
            evidence = f", as the {self.shown_by} show" if self.shown_by else ""
            notes.append(f"the cameras are {self.frame.description}{evidence}")
        return notes


def with_poses(grid: Grid, poses: PosesInConvention) -> Grid:
    """Return a grid whose cameras have the ``poses`` as read in another convention."""
    file = replace(grid.camera_file, viewmats=poses.viewmats, convention=poses.convention)
    return replace(grid, camera_file=file, cameras=replace(grid.cameras, viewmats=poses.viewmats))


def with_photo_size(camera_file: CameraFile, size: Size | None) -> CameraFile:
    """Return cameras with the ``size`` of the photos if the cameras' own size differs from it by one pixel.

    If a file does not state the size, it was computed as twice the principal point, which is not exact. Cameras whose
    size differs by more than one pixel, or not at all, are returned as they are.
    """
    stored = sizes_of(camera_file)
    if size is None or len(stored) != 1 or not 0 < max(abs(np.subtract(stored[0], size))) <= 1:
        return camera_file
    widths, heights = (np.full_like(camera_file.widths, side) for side in size)
    return replace(camera_file, widths=widths, heights=heights)


def photo_grid(camera_file: CameraFile, size: Size | None) -> Grid:
    """Return the grid at the ``size`` of the photos, or at the size of the cameras if there are no photos (None).

    Raises SceneError if cameras and photos have different ratios of width to height.
    """
    if size is None:
        return Grid(camera_file, to_cameras(camera_file), None, ())
    if camera_file.photo_map is not None:  # the size of photos, and how they are resized and cropped to the grid
        return _mapped_grid(camera_file, size, *camera_file.photo_map)
    width, height = size
    for w, h in sizes_of(camera_file):
        if not same_shape((w, h), size):
            if camera_file.source == FFGS:
                return _mapped_grid(camera_file, size, size, resize_and_crop(size, (w, h)))
            problem = f"expected cameras of the images' size {width} x {height} or a multiple of it, found {w} x {h}"
            swapped = (w, h) == (height, width)
            remedy = "width and height are swapped" if swapped else "crop cameras and images alike"
            raise SceneError(camera_file.path, problem, remedy)
    scaled = [camera_size for camera_size in sizes_of(camera_file) if camera_size != size]
    notes = tuple(f"intrinsics scaled from {w} x {h} to the images' {width} x {height}" for w, h in scaled)
    return Grid(camera_file, to_cameras(camera_file, size), None, notes)


def _mapped_grid(camera_file: CameraFile, size: Size, file_size: Size, file_transform: PhotoTransform) -> Grid:
    """Return the grid to which a known transform resizes or crops photos.

    ``file_transform`` transforms photos of ``file_size``. The photos in memory have ``size``, which may be smaller.
    """
    ratio_x, ratio_y = (file_side / side for file_side, side in zip(file_size, size, strict=True))
    scale_x, scale_y = ratio_x * file_transform.scale_x, ratio_y * file_transform.scale_y
    transform = replace(file_transform, scale_x=scale_x, scale_y=scale_y)
    note = f"photos of {file_size[0]} x {file_size[1]} are {transform.description}, the Gaussian grid's size"
    max_difference = 0.1  # few models resize width and height by factors with a larger relative difference
    if camera_file.source == ESTIMATED and abs(scale_x / scale_y - 1) > max_difference:
        note += "; if the model did not squeeze them, rows were left out of the file: name its cameras with --cameras"
    is_same = file_size == (transform.width, transform.height)
    return Grid(camera_file, to_cameras(camera_file), transform, () if is_same else (note,))


def file_grids(camera_file: CameraFile, size: Size | None) -> list[Grid]:
    """Return a list with the grid at the size of the cameras, if the photos have another ``size``.

    Photos are resized to the size of the cameras. If photos and cameras differ in shape, cameras are cropped to the
    photos instead. The list is empty without photos, if photos and cameras have one size, and if photos would be
    enlarged too much.
    """
    sizes = sizes_of(camera_file)
    if size is None or len(sizes) != 1 or sizes[0] == size or camera_file.photo_map is not None:
        return []
    (camera_size,) = sizes
    cameras, transform = to_cameras(camera_file, camera_size), resize_to(size, camera_size)
    if not same_shape(camera_size, size):
        crop = resize_and_crop(camera_size, size)
        note = f"cameras of {camera_size[0]} x {camera_size[1]} are {crop.description}, the images' size"
        return [Grid(camera_file, crop.cameras(cameras), None, (note,))]
    max_enlarged = 1.5  # largest factor by which photos are enlarged; some networks enlarge small photos
    if max(transform.scale_x, transform.scale_y) > max_enlarged:
        return []  # the photos are previews, and a fit to them would blur the Gaussians
    note = f"photos of {size[0]} x {size[1]} are {transform.description}, the cameras' and the Gaussian grid's size"
    return [Grid(camera_file, cameras, transform, (note,))]
