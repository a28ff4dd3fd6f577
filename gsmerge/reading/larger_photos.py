"""Limit the size of a scene's photos, and read its larger photos and its masks."""

from __future__ import annotations

import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.io.cameras.camera_file import CameraFile, to_cameras, undistort_photos
from gsmerge.io.photo_files import (
    PhotoArrays,
    PhotoTransform,
    Size,
    decode_photos,
    keep_photos,
    limit_size,
    photo_size,
    resize_to,
)
from gsmerge.method.kernels.matrices import matmul
from gsmerge.reading.photos.masks import NO_MASKS, Masks, read_masks
from gsmerge.reading.photos.scene_photos import ScenePhotos
from gsmerge.reading.scene_files import SceneFiles
from gsmerge.types import Cameras, LargePhotos

_MAX_BYTES = 2 << 30  # photos of at most this size, as floats, are resized only if rows have no pixels
_EDGE_ROUNDING = 1e-6  # pixels by which the edge of a window may be off


@dataclass(frozen=True, eq=False)
class PhotoSource:
    """The photos of a scene's views as they are stored, and how the views' pictures follow from them."""

    camera_file: CameraFile  # the cameras as stored, with lenses
    photos: ScenePhotos  # the photos of these cameras
    size: Size | None  # size of the undistorted photos; None without photos
    transform: PhotoTransform | None  # from undistorted photos to the pixels of the rows; None: they are not changed


def read_larger_and_masks(
    files: SceneFiles, source: PhotoSource, cameras: Cameras, *, is_plain: bool = False
) -> tuple[LargePhotos | None, Masks, list[str]]:
    """Read the photos at the size of their files, if this size is larger than the scene's, and the masks of photos.

    A larger photo is read from its file when it is used. Photos inside other files stay in memory. Masks come from
    files and, unless ``is_plain``, from the photos' transparency.

    ``files`` are those of the scene, and ``cameras`` the scene's cameras. Returns the larger photos (None if there are
    none), the masks, and notes.
    """
    photos = source.photos
    camera_file = source.camera_file
    stored = photos.file_size or photo_size(photos.pictures)
    if stored is None or source.size is None:
        return None, NO_MASKS, []
    # The part of each photo's file that its view shows: the window. All arrays hold x and y
    to_grid = source.transform or resize_to(source.size, source.size)
    # from pixels of the file to a grid
    scale = np.array([to_grid.scale_x, to_grid.scale_y]) * source.size / np.array(stored)
    corner = np.array([to_grid.left, to_grid.top])
    grid_size = np.array([to_grid.width, to_grid.height])
    reduction = np.array([cameras.width, cameras.height]) / grid_size  # views of unaligned scenes may be reduced again
    start = np.floor(corner / scale).astype(int)
    stop = np.minimum(np.ceil((corner + grid_size) / scale - _EDGE_ROUNDING).astype(int), stored)
    (left, top), (right, bottom) = start.tolist(), stop.tolist()
    lenses = camera_file.lenses if photos.paths else ()
    Ks = to_cameras(replace(camera_file, lenses=()), stored).Ks if lenses else None

    def cut(view: int, picture: np.ndarray) -> np.ndarray:
        """Undistort a picture of the upright photo's size, and crop it to what the view shows."""
        if Ks is not None:
            picture = undistort_photos([picture], Ks[view : view + 1], lenses[view : view + 1])[0]
        return np.ascontiguousarray(picture[top:bottom, left:right])

    def read(view: int) -> np.ndarray:
        """Return the larger photo of a view."""
        if not photos.paths:
            return cut(view, photos.pictures[view])
        of_view = slice(view, view + 1)
        return cut(view, decode_photos(photos.paths[of_view], photos.turns[of_view], stored, photos.parts[of_view])[0])

    large = None
    if (scale * reduction).max() < 1:  # the window has more pixels than the view on both sides
        to_file = np.eye(3)  # maps pixels of the view to pixels of the window
        to_file[(0, 1), (0, 1)] = 1 / (scale * reduction)
        to_file[:2, 2] = corner / scale - start
        Ks_of_file = matmul(to_file, cameras.Ks)
        large = LargePhotos(Ks_of_file, right - left, bottom - top, tuple(range(len(cameras))), read)
    return large, *read_masks(
        files, camera_file, photos=photos, stored=stored, cut=cut, cameras=cameras, is_plain=is_plain
    )


def limit_photo_size(
    photos: PhotoArrays, num_rows: int, max_side: int, *, unaligned: bool
) -> tuple[PhotoArrays, list[str]]:
    """Resize photos that are too large for memory to at most ``max_side`` pixels per side; return them and notes.

    Photos that fit into memory keep their size. Photos also keep their size if they have less than twice as many pixels
    as there are rows, because the rows may be these pixels. If ``unaligned`` is True, the rows are known to have no
    pixels, so photos are resized whatever memory they take.
    """
    size = photo_size(photos)
    if size is None:
        return photos, []
    num_pixels = len(photos) * size[0] * size[1]
    pixel_bytes = 12  # bytes of a pixel as three floats
    if not unaligned and (pixel_bytes * num_pixels <= _MAX_BYTES or 2 * num_rows > num_pixels):
        return photos, []
    transform, notes = _choose_reduction(size, max_side)
    return photos if transform is None else keep_photos(transform.photos(photos)), notes


def limit_view_size(cameras: Cameras, images: np.ndarray, max_side: int) -> tuple[Cameras, np.ndarray, list[str]]:
    """Resize cameras and photos ``[c,h,w,3]`` to at most ``max_side`` pixels per side; return them and notes.

    The photos look as if they had been read from files at this size. Where photos are compared with renders of another
    size, :func:`gsmerge.scoring.sizes.shrink_views` serves instead, and resizes photos as it resizes renders.
    """
    transform, notes = _choose_reduction((cameras.width, cameras.height), max_side)
    if transform is not None:
        cameras = transform.cameras(cameras)
        smaller = transform.photos(images)
        images = np.array([smaller[view] for view in range(len(smaller))], images.dtype).reshape(
            -1, cameras.height, cameras.width, 3
        )
    return cameras, images, notes


def _choose_reduction(size: Size, max_side: int) -> tuple[PhotoTransform | None, list[str]]:
    """Return how pictures are reduced to ``max_side`` pixels per side, and a note; None for pictures small enough."""
    smaller = limit_size(size, max_side)
    if smaller == size:
        return None, []
    sizes = f"views of {size[0]} x {size[1]} are resized to {smaller[0]} x {smaller[1]}"
    return resize_to(size, smaller), [f"{sizes}, since max_side allows {max_side} pixels per side"]
