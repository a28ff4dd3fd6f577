"""Bring cameras and photos to the size of the pixel grid, which is the size of the photos or of the cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass, replace
from gsmerge.io.cameras.camera_file import MAX_NORMALISED_FOCAL, CameraFile, Convention, sizes_of, to_cameras
from gsmerge.io.cameras.table import FFGS
from gsmerge.io.photo_files import PhotoTransform, Size, resize_and_crop, resize_to, same_shape
from gsmerge.method.geometry.transforms import IDENTITY, Similarity
from gsmerge.reading.alignment.conventions import PosesInConvention, describe_convention
from gsmerge.reading.alignment.layouts import ESTIMATED
from gsmerge.types import Cameras

_PATCH = 14  # pixels; sides of vision transformers' inputs are multiples of this
MAX_ENLARGED = 1.5  # largest factor by which photos are enlarged; some networks enlarge small photos
_WHOLE_PX = 1e-3  # a side counts as whole if it differs from a whole number by less than these pixels


@dataclass(frozen=True, eq=False)
class Grid:
    """The cameras and the photo transform for one size of the pixel grid, and the frame of the Gaussians."""

    camera_file: CameraFile  # the cameras as they are read, in one convention of the poses
    cameras: Cameras  # the same cameras at the size of the grid, in their own world
    transform: PhotoTransform | None  # transform of the photos to the grid; None: photos stay as they are
    remarks: tuple[str, ...]  # notes for the user on this size, one sentence each
    moves: Sequence[dict[str, Any]] = ()  # how far each camera was moved to its Gaussians; empty if none was moved
    # ``[c,4,4]`` poses as read, if photos confirm them, so that the Gaussians have to move instead; otherwise None
    confirmed_viewmats: np.ndarray | None = None
    frame: Similarity = IDENTITY  # from the cameras' own world to the frame of the Gaussians
    shown_by: str = ""  # evidence for the frame, in words; empty for a frame that a file gives
    mismatch: SceneError | None = None  # what is wrong with cameras that had to be cropped, if the grid does not fit
    previews: bool = False  # the photos are much smaller than the grid, and are not used

    @property
    def size(self) -> Size:
        """Width and height of the grid, in pixels."""
        return self.cameras.width, self.cameras.height

    @property
    def placed(self) -> Cameras:
        """The cameras in the frame of the Gaussians."""
        return self.cameras if self.frame is IDENTITY else self.frame.move_cameras(self.cameras)

    def list_notes(self, usual: Convention) -> list[str]:
        """List notes on what was changed in the cameras. ``usual`` is the pose convention of the file's format."""
        notes = [*self.remarks]
        convention = self.camera_file.convention
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


def with_sizes(camera_file: CameraFile, size: Size | None) -> CameraFile:
    """Return cameras with sizes in pixels that their file does not state, or states inexactly.

    ``size`` is that of the photos. Cameras without a size get twice their principal point, unless this is nearly the
    size of the photos, or has another aspect ratio; sides that are not whole numbers are rounded to multiples of
    ``_PATCH``, since sides of networks' inputs are such multiples. Cameras whose size differs from ``size`` by one
    pixel get ``size``, because readers compute sizes that are not stated as twice the principal point, too.
    """
    stored = sizes_of(camera_file)
    if size is None or len(stored) > 1:
        return camera_file
    if not stored:
        sides = 2 * np.median(camera_file.Ks[:, :2, 2], 0)
        ratios = sides / size
        min_difference = 0.1  # sizes are different if their sides differ by at least this share
        has_shape = float(ratios.max()) < (1 + min_difference) * float(ratios.min())
        if not has_shape or (sides < MAX_NORMALISED_FOCAL).any() or not (np.abs(ratios - 1) > min_difference).all():
            return camera_file
        step = 1 if (np.abs(sides - sides.round()) < _WHOLE_PX).all() else _PATCH
        size = step * round(float(sides[0]) / step), step * round(float(sides[1]) / step)
    elif not 0 < max(abs(np.subtract(stored[0], size))) <= 1:
        return camera_file
    widths, heights = (np.full_like(camera_file.widths, side) for side in size)
    return replace(camera_file, widths=widths, heights=heights)


def list_grids(camera_file: CameraFile, size: Size | None, num_rows: int) -> list[Grid]:
    """List the grids whose pixels the ``num_rows`` rows of a file may be, the likeliest first.

    ``size`` is that of the photos; None without photos. The grids are

    1. the grid to which the program that wrote the cameras resizes and crops photos, if that is known;
    2. the photos, with cameras at their size, or without photos the cameras at their own size;
    3. the cameras at their own size, with photos resized to it;
    4. the photos, with cameras cropped to their shape, if photos and cameras differ in shape;
    5. a grid in the photos' shape that has as many pixels as there are rows.

    Photos that would be enlarged too much are previews, which are not used, as a fit to them would blur the Gaussians.

    Raises SceneError if photos and cameras differ in shape, and the cameras have several sizes.
    """
    if size is None:
        return [Grid(camera_file, to_cameras(camera_file), None, ())]
    if camera_file.photo_map is not None:  # the size of photos, and how they are resized and cropped to the grid
        return [_mapped_grid(camera_file, size, *camera_file.photo_map)]
    stored = sizes_of(camera_file)
    width, height = size
    grids = list[Grid]()
    mismatch = next((camera_size for camera_size in stored if not same_shape(camera_size, size)), None)
    if mismatch is None:
        scaled = [camera_size for camera_size in stored if camera_size != size]
        remarks = tuple(f"intrinsics scaled from {w} x {h} to the images' {width} x {height}" for w, h in scaled)
        grids.append(Grid(camera_file, to_cameras(camera_file, size), None, remarks))
    elif camera_file.source == FFGS:
        return [_mapped_grid(camera_file, size, size, resize_and_crop(size, mismatch))]
    if len(stored) == 1 and stored[0] != size:
        (camera_size,) = stored
        if mismatch is None:
            grids.append(_grid_of_size(camera_file, size, camera_size, "the cameras' and the Gaussian grid's size"))
        else:
            crop = resize_and_crop(camera_size, size)
            remark = f"cameras of {camera_size[0]} x {camera_size[1]} are {crop.description}, the images' size"
            cameras = crop.cameras(to_cameras(camera_file, camera_size))
            grids.append(Grid(camera_file, cameras, None, (remark,)))
    rows_size = _size_of_rows(size, num_rows, len(camera_file))
    if mismatch is None and rows_size is not None and rows_size not in (size, *stored):
        grid = _grid_of_size(camera_file, size, rows_size, "the Gaussian grid's size")
        if grid.previews:
            grids.append(grid)
        elif MAX_ENLARGED * rows_size[0] < width:  # rows of a little smaller grid are pixels without their borders
            grids.insert(0, grid)  # before the photos' own size, because rows may hit centres of its pixels, too
    if mismatch is not None:
        found = "{} x {}".format(*mismatch)
        problem = f"expected cameras of the images' size {width} x {height} or a multiple of it, found {found}"
        swapped = mismatch == (height, width)
        remedy = "width and height are swapped" if swapped else "crop cameras and images alike"
        error = SceneError(camera_file.path, problem, remedy)
        if not grids:
            raise error
        grids = [replace(grid, mismatch=error) for grid in grids]
    return grids


def _size_of_rows(size: Size, num_rows: int, num_views: int) -> Size | None:
    """Return the size of a grid in the shape of photos of ``size``, of which each row is a pixel; None if none is."""
    width = round(math.sqrt(num_rows / num_views * size[0] / size[1]))
    height = num_rows // max(1, num_views * width)
    is_grid = num_views * width * height == num_rows and same_shape((width, height), size)
    return (width, height) if is_grid else None


def _grid_of_size(camera_file: CameraFile, size: Size, grid_size: Size, words: str) -> Grid:
    """Return a grid of another size than the photos' ``size``, to which photos are resized; ``words`` name its size.

    Photos that are much smaller than the grid are previews.
    """
    cameras = to_cameras(camera_file, grid_size)
    transform = resize_to(size, grid_size)
    photos = "photos of {} x {} are".format(*size)
    if max(transform.scale_x, transform.scale_y) > MAX_ENLARGED:
        small = "much smaller than the Gaussian grid of {} x {}, so Gaussians keep their own colours".format(*grid_size)
        return Grid(camera_file, cameras, None, (f"{photos} {small}",), previews=True)
    return Grid(camera_file, cameras, transform, (f"{photos} {transform.description}, {words}",))


def _mapped_grid(camera_file: CameraFile, size: Size, file_size: Size, file_transform: PhotoTransform) -> Grid:
    """Return the grid to which a known transform resizes or crops photos.

    ``file_transform`` transforms photos of ``file_size``. The photos in memory have ``size``, which may be smaller.
    """
    ratio_x, ratio_y = (file_side / side for file_side, side in zip(file_size, size, strict=True))
    scale_x = ratio_x * file_transform.scale_x
    scale_y = ratio_y * file_transform.scale_y
    transform = replace(file_transform, scale_x=scale_x, scale_y=scale_y)
    note = f"photos of {file_size[0]} x {file_size[1]} are {transform.description}, the Gaussian grid's size"
    max_difference = 0.1  # few models resize width and height by factors with a larger relative difference
    if camera_file.source == ESTIMATED and abs(scale_x / scale_y - 1) > max_difference:
        note += "; if the model did not squeeze them, rows were left out of the file: name its cameras with --cameras"
    is_same = file_size == (transform.width, transform.height)
    return Grid(camera_file, to_cameras(camera_file), transform, () if is_same else (note,))
