"""The cameras and photos of a scene: read, turned, cut, at a size that memory has room for; masks and larger files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import CameraFile, drop_repeats, sizes_of, to_cameras, undistort_photos
from gsmerge.io.cameras.read import read_cameras, read_sharp_camera
from gsmerge.io.formats.read import GaussianFile
from gsmerge.io.image_names import match_masks
from gsmerge.io.photo_files import (
    PhotoArrays,
    PhotoTransform,
    Size,
    change_photos,
    decode_alpha,
    decode_mask,
    decode_views,
    image_size,
    keep_photos,
    photo_size,
    resize_to,
    same_shape,
)
from gsmerge.kernels.matrices import matmul
from gsmerge.kernels.pictures import count_bars, turn_picture
from gsmerge.runtime.threads import parallel_map
from gsmerge.scene.files import SceneFiles
from gsmerge.scene.photos import ScenePhotos, stored_photos
from gsmerge.types import Cameras, LargePhotos

_MAX_BYTES = 2 << 30  # of all photos as floats, before it is known whether the Gaussians belong to pixels
_FLOAT_PIXEL = 12  # bytes
_BAR_SPREAD = 8  # of 255, range of a bar's colours
_ROUNDING = 1e-6  # pixels
_MAX_MASKED = 0.98  # share of the pixels of photos that masks may leave out
_MASK_LEVEL = 191  # of 255: a pixel of a view counts if three quarters of its pixels in the file do


def read_scene_cameras(ply: GaussianFile, files: SceneFiles) -> CameraFile | None:
    """Read a scene's cameras from their file or the ``.ply``, or estimate them; None if there are none.

    If a file has only poses, the focal length is estimated; SceneError if that fails. Views that repeat others count
    once, unless there may be as many rows for each.
    """
    stored = None
    if files.cameras is not None:
        stored = read_cameras(files.cameras, scene=files.ply.stem, folder=files.ply.parent)
        if len(ply.gaussians) % len(stored):  # otherwise each may have rows of its own
            stored = drop_repeats(stored)
        if stored.focal is not None:
            return stored
    if stored is None and files.is_state:
        return None
    sharp = read_sharp_camera(files.ply) if stored is None and "cameras" not in files.named else None
    if sharp is not None:
        return sharp
    from gsmerge.scene.estimate_cameras import estimate_cameras, estimate_focal  # few files need it

    if stored is not None:
        return estimate_focal(ply, stored, stored_photos(files, stored))
    folder = files.images if files.images is not None and files.images.is_dir() else None
    return estimate_cameras(ply, files.ply, folder)


def find_larger_and_masks(
    files: SceneFiles,
    camera_file: CameraFile,
    photos: ScenePhotos,
    size: Size | None,
    transform: PhotoTransform | None,
    cameras: Cameras,
) -> tuple[LargePhotos | None, np.ndarray | None, list[str]]:
    """Find the photos at full file size, if that is larger than the scene's, and masks of the pixels that count.

    Files are read again when a photo is asked for; photos inside other files stay in memory. ``size`` is that of the
    undistorted photos, and ``transform`` how they were fitted to the rows; ``cameras`` are the scene's, in the order of
    the camera file. Masks ``[c,h,w]`` bool come from files and from transparency; None if all pixels count. Also
    returns notes.
    """
    stored = photos.file_size or photo_size(photos.pictures)
    if stored is None or size is None:
        return None, None, []
    paths = photos.paths
    window = _file_window(stored, size, transform, cameras)
    lenses = camera_file.lenses if paths else ()
    Ks = to_cameras(replace(camera_file, lenses=()), stored).Ks if lenses else None

    def cut(view: int, picture: np.ndarray) -> np.ndarray:
        """Undistort a picture of the photo's upright size, and crop it to the view."""
        if Ks is not None:
            picture = undistort_photos([picture], Ks[view : view + 1], lenses[view : view + 1])[0]
        return np.ascontiguousarray(picture[window.rows, window.columns])

    def read(view: int) -> np.ndarray:
        one = slice(view, view + 1)
        return cut(view, decode_views(paths[one], photos.turns[one], stored)[0] if paths else photos.pictures[view])

    large = None
    if window.is_larger:
        width, height = (part.stop - part.start for part in (window.columns, window.rows))
        large = LargePhotos(matmul(window.to_file, cameras.Ks), width, height, tuple(range(len(cameras))), read)
    names = [path.as_posix() for path in paths if path is not None] if paths else list(camera_file.names)
    named, notes = _match_masks(files, names)
    if paths:
        of_path = dict(zip((path for path in paths if path is not None), named, strict=True))
        named = [None if path is None else of_path[path] for path in paths]
    turns = photos.turns or (0,) * len(named)

    def read_parts(view: int) -> list[np.ndarray]:
        """Read the mask, as stored or upright, and the photo's transparency, which is as stored."""
        mask, photo = named[view], paths[view] if paths else None
        alpha = None if photo is None else decode_alpha(photo)
        parts = [] if alpha is None else [turn_picture(alpha, turns[view])]
        if mask is not None:
            whole = decode_mask(mask, photo)
            as_stored = photo is not None and turns[view] % 2 and same_shape(image_size(photo), whole.shape[1::-1])
            parts.append(turn_picture(whole, turns[view]) if as_stored else whole)
        return parts

    return large, _read_masks(read_parts, len(named), stored, cameras, cut), notes


def _match_masks(files: SceneFiles, names: Sequence[str]) -> tuple[Sequence[Path | None], list[str]]:
    """Find the masks of photos, with a note; in a folder that the user did not name, only by matching names."""
    if files.masks is None:
        return [None] * len(names), []
    try:
        return match_masks(files.masks, names), []
    except SceneError as error:
        if "masks" in files.named:
            raise
        return [None] * len(names), [f"masks are not used: {error.path}: {error.problem}"]


def _read_masks(
    read_parts: Callable[[int], list[np.ndarray]],
    count: int,
    size: Size,
    cameras: Cameras,
    cut: Callable[[int, np.ndarray], np.ndarray],
) -> np.ndarray | None:
    """Read the masks of photos of an upright ``size``; ``cut`` crops a mask to the view."""
    shape = cameras.height, cameras.width

    def read(view: int) -> np.ndarray | None:
        mask = np.full(shape, True)
        for part in read_parts(view):
            whole = cv2.resize(part.astype(np.uint8) * 255, size, interpolation=cv2.INTER_NEAREST)
            seen = cut(view, whole[..., None].repeat(3, -1))[..., 0]
            mask &= cv2.resize(seen, shape[::-1], interpolation=cv2.INTER_AREA) > _MASK_LEVEL
        return None if mask.all() else mask

    masks = parallel_map(read, range(count))
    if all(mask is None for mask in masks):
        return None
    return np.stack([np.full(shape, True) if mask is None else mask for mask in masks])


def check_masks(masks: np.ndarray | None, files: SceneFiles) -> tuple[np.ndarray | None, list[str]]:
    """Note the share of the photos that masks leave out; SceneError if masks from files leave out nearly all."""
    if masks is None:
        return None, []
    share = float(1 - masks.mean())
    if share < _MAX_MASKED:
        count = int((~masks.all((1, 2))).sum())
        return masks, [f"masks leave out {100 * share:.0f} % of the photos; of {len(masks)}, {count} have one"]
    if files.masks is None:
        return None, ["the photos are transparent nearly everywhere, which is not taken for masks"]
    problem = f"expected masks that are bright where photos count, found {100 * share:.0f} % dark"
    if "masks" not in files.named:
        return None, [f"masks are not used: {files.masks}: {problem}; name them with --masks"]
    raise SceneError(files.masks, problem, "invert them, or name another folder with --masks")


@dataclass(frozen=True)
class _Window:
    """The part of a photo's file that a view of the grid shows."""

    rows: slice
    columns: slice
    to_file: np.ndarray  # [3,3] from pixels of the grid to those of the part
    is_larger: bool  # whether it has more pixels than the view on both sides


def _file_window(stored: Size, size: Size, transform: PhotoTransform | None, cameras: Cameras) -> _Window:
    """Find the part of files with the size ``stored`` that the grid shows; see :func:`find_larger_and_masks`."""
    fitted = transform or resize_to(size, size)
    scale = np.array([fitted.scale_x, fitted.scale_y]) * size / np.array(stored)
    cut, grid = np.array([fitted.left, fitted.top]), np.array([fitted.width, fitted.height])
    shown = np.array([cameras.width, cameras.height]) / grid  # of unaligned scenes, whose views may be reduced again
    first = np.floor(cut / scale).astype(int)
    last = np.minimum(np.ceil((cut + grid) / scale - _ROUNDING).astype(int), stored)
    to_file = np.eye(3)
    to_file[(0, 1), (0, 1)] = 1 / (scale * shown)
    to_file[:2, 2] = cut / scale - first
    (left, top), (right, bottom) = first.tolist(), last.tolist()
    return _Window(slice(top, bottom), slice(left, right), to_file, bool((scale * shown).max() < 1))


def cut_bars(photos: PhotoArrays, camera_file: CameraFile) -> tuple[PhotoArrays, list[str]]:
    """Cut off bars around photos if the rest has the cameras' shape, with a note; otherwise change nothing."""
    size = photo_size(photos)
    shapes = sizes_of(camera_file)
    if size is None or not shapes or camera_file.photo_map is not None:
        return photos, []
    if any(same_shape(shape, size) for shape in shapes):
        return photos, []
    counts = [count_bars(photos[view], _BAR_SPREAD) for view in range(len(photos))]
    above, below, left, right = (int(count) for count in np.median(counts, 0))
    inner = size[0] - left - right, size[1] - above - below
    if inner == size or not any(same_shape(shape, inner) for shape in shapes):
        return photos, []

    def cut(_: int, photo: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(photo[above : size[1] - below, left : size[0] - right])

    note = f"the photos of {size[0]} x {size[1]} have bars around pictures of {inner[0]} x {inner[1]}: they are cut off"
    return keep_photos(change_photos(photos, cut, inner)), [note]


def limit_photo_size(
    photos: PhotoArrays, rows: int, max_side: int, *, unaligned: bool
) -> tuple[PhotoArrays, list[str]]:
    """Resize photos that are too large for memory to at most ``max_side`` pixels per side, with notes.

    Photos whose pixels may be the ``rows`` Gaussians of the file keep their size, unless they are known to be
    ``unaligned``.
    """
    size = photo_size(photos)
    if size is None:
        return photos, []
    pixels = len(photos) * size[0] * size[1]
    if not unaligned and (_FLOAT_PIXEL * pixels <= _MAX_BYTES or 2 * rows > pixels):
        return photos, []
    transform, notes = _limit(size, max_side)
    return photos if transform is None else keep_photos(transform.photos(photos)), notes


def limit_view_size(cameras: Cameras, images: np.ndarray, max_side: int) -> tuple[Cameras, np.ndarray, list[str]]:
    """Resize cameras and photos ``[c,h,w,3]`` to at most ``max_side`` pixels per side; with a note."""
    transform, notes = _limit((cameras.width, cameras.height), max_side)
    if transform is not None:
        cameras, smaller = transform.cameras(cameras), transform.photos(images)
        pictures = np.array([smaller[view] for view in range(len(smaller))], images.dtype)
        images = pictures.reshape(-1, cameras.height, cameras.width, 3)
    return cameras, images, notes


def _limit(size: Size, max_side: int) -> tuple[PhotoTransform | None, list[str]]:
    """Make the transform that resizes pictures to ``max_side``, and a note; None if they are small enough."""
    if max(size) <= max_side:
        return None, []
    scale = max_side / max(size)
    width, height = (max(1, round(side * scale)) for side in size)
    note = f"views of {size[0]} x {size[1]} are worked on at {width} x {height}"
    return resize_to(size, (width, height)), [f"{note}: no side is longer than {max_side} pixels (max_side)"]
