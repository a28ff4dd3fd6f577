"""The cameras and photos of a scene, wherever they are, at a size that memory has room for."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.alignment.estimate_cameras import estimate_cameras
from gsmerge.io.cameras.camera_file import CameraFile, to_cameras, undistort_photos
from gsmerge.io.cameras.re10k import SUFFIX as CHUNK
from gsmerge.io.cameras.read import CAMERA_PLACES, SHARP, read_cameras, read_sharp
from gsmerge.io.formats.ply import PlyScene
from gsmerge.io.photos import (
    Photos,
    PhotoTransform,
    Size,
    decode_image,
    decode_images,
    find_image,
    image_size,
    keep_photos,
    list_images,
    match_images,
    photo_size,
    resize_to,
)
from gsmerge.io.scene_files import SceneFiles
from gsmerge.types import Cameras, LargePhotos

_MAX_BYTES = 2 << 30  # of all photos as floats, before it is known whether the Gaussians belong to pixels
_FLOAT_PIXEL = 12  # bytes
_ROUNDING = 1e-6  # pixels


def read_scene_cameras(ply: PlyScene, files: SceneFiles) -> CameraFile:
    """The cameras: from their file, from the ``.ply`` itself, or estimated for the images where there is nothing else.
    SceneError if there are none and they cannot be estimated.
    """
    if files.cameras is not None:
        return read_cameras(files.cameras, scene=files.ply.stem)
    cameras = read_sharp(files.ply)
    if cameras is None and files.images is not None and files.images.is_dir():
        paths = list_images(files.images)
        width, height = image_size(paths[0]) if paths else (0, 0)
        names = [path.relative_to(files.images).as_posix() for path in paths]
        cameras = estimate_cameras(files.ply, ply.gaussians, ply.valid, names, width, height)
    if cameras is None:
        places = ", ".join(place for place in CAMERA_PLACES if len(place) > 1)
        problem = f"no cameras found next to it (looked for {places}, one .torch chunk)"
        raise SceneError(files.ply, problem, "name them with --cameras, or have views placed with --hint order=none")
    return cameras


def stored_photos(files: SceneFiles, camera_file: CameraFile) -> Photos | None:
    """The photos of the cameras: from the folder, an ``.npz`` or ``.torch``, or where the camera file itself says.

    None if there are none. Raises as :func:`gsmerge.io.read_images`.
    """
    photos = _stored_photos(files, camera_file)
    old, size = photo_size(photos), (int(camera_file.widths[0]), int(camera_file.heights[0]))
    if photos is None or old is None or camera_file.source != SHARP or old == size:
        return photos
    return resize_to(old, size).photos(photos)


def _stored_photos(files: SceneFiles, camera_file: CameraFile) -> Photos | None:
    paths = _photo_paths(files, camera_file)
    if paths is not None or files.images is None:
        return decode_images(paths) if paths else None
    own = files.cameras is not None and os.path.realpath(files.cameras) == os.path.realpath(files.images)
    stored = (camera_file if own else read_cameras(files.images, scene=files.ply.stem)).images
    if own and stored is None and files.images.suffix == CHUNK:
        return None
    if stored is None or len(stored) != len(camera_file):
        count = 0 if stored is None else len(stored)
        raise SceneError(files.images, f"expected {len(camera_file)} images, one per camera, found {count}")
    return stored


def _photo_paths(files: SceneFiles, camera_file: CameraFile) -> list[Path] | None:
    """The photo file of every camera; None where there are none, or they are inside another file."""
    if files.images is None:
        folder = Path(camera_file.path).parent
        paths = [path for path in (find_image(folder, name) for name in camera_file.names) if path is not None]
        return paths if len(paths) == len(camera_file) else None
    return None if files.images.suffix in (".npz", CHUNK) else match_images(files.images, camera_file.names)


def find_large_photos(
    files: SceneFiles,
    camera_file: CameraFile,
    photos: Photos | None,
    size: Size | None,
    transform: PhotoTransform | None,
    cameras: Cameras,
) -> LargePhotos | None:
    """The photos at the size of their files, where that is larger than the scene's; None where it is not.

    Files are read again when a photo is asked for; what other files hold inside stays in memory.

    Args:
        files: Of the scene.
        camera_file: As it was read, with lenses.
        photos: The photos as :func:`stored_photos` gave them, undistorted.
        size: Theirs when they were fitted to the rows.
        transform: What was done to them then.
        cameras: Of the scene's grid, in the order of the camera file.
    """
    paths = _photo_paths(files, camera_file) if photos is not None else None
    stored = photo_size(photos) if paths is None else image_size(paths[0])
    if photos is None or stored is None or size is None:
        return None
    fitted = transform or resize_to(size, size)
    scale = np.array([fitted.scale_x, fitted.scale_y]) * size / np.array(stored)
    cut, grid = np.array([fitted.left, fitted.top]), np.array([fitted.width, fitted.height])
    shown = np.array([cameras.width, cameras.height]) / grid  # of unaligned scenes, whose views may be reduced again
    if (scale * shown).max() >= 1:
        return None
    first = np.floor(cut / scale).astype(int)
    last = np.minimum(np.ceil((cut + grid) / scale - _ROUNDING).astype(int), stored)
    to_file = np.eye(3)
    to_file[(0, 1), (0, 1)] = 1 / (scale * shown)
    to_file[:2, 2] = cut / scale - first
    rows, columns = slice(first[1], last[1]), slice(first[0], last[0])
    Ks = to_cameras(replace(camera_file, lenses=()), stored).Ks if camera_file.lenses else None

    def read(view: int) -> np.ndarray:
        photo = photos_inside[view] if paths is None else decode_image(paths[view], stored)
        if paths is not None and Ks is not None:
            photo = undistort_photos([photo], Ks[view : view + 1], camera_file.lenses[view : view + 1])[0]
        return photo[rows, columns]

    photos_inside = photos if paths is None else ()
    width, height = (int(side) for side in last - first)
    return LargePhotos(to_file @ cameras.Ks, width, height, tuple(range(len(cameras))), read)


def limit_photo_size(
    photos: Photos | None, rows: int, max_side: int, *, unaligned: bool
) -> tuple[Photos | None, list[str]]:
    """Decoded photos at a size that memory has room for, none of what does not fit longer than ``max_side``; and a
    note.

    Where the file's Gaussians (``rows``) may be the photos' pixels as they are, the photos stay; not where they are
    known to be unaligned.
    """
    size = photo_size(photos)
    if photos is None or size is None:
        return photos, []
    pixels = len(photos) * size[0] * size[1]
    if not unaligned and (_FLOAT_PIXEL * pixels <= _MAX_BYTES or 2 * rows > pixels):
        return photos, []
    transform, notes = _limit(size, max_side)
    return photos if transform is None else keep_photos(transform.photos(photos)), notes


def limit_view_size(
    cameras: Cameras, images: np.ndarray | None, max_side: int
) -> tuple[Cameras, np.ndarray | None, list[str]]:
    """Cameras and photos ``[c,h,w,3]`` of unaligned Gaussians, no side longer than ``max_side`` pixels; and a note."""
    transform, notes = _limit((cameras.width, cameras.height), max_side)
    if transform is not None:
        cameras = transform.cameras(cameras)
        smaller = None if images is None else transform.photos(images)
        images = None if smaller is None else np.stack([smaller[view] for view in range(len(smaller))])
    return cameras, images, notes


def _limit(size: Size, max_side: int) -> tuple[PhotoTransform | None, list[str]]:
    """What brings pictures to ``max_side``, and a note; None where nothing has to."""
    if max(size) <= max_side:
        return None, []
    scale = max_side / max(size)
    width, height = (max(1, round(side * scale)) for side in size)
    note = f"views of {size[0]} x {size[1]} are worked on at {width} x {height}"
    return resize_to(size, (width, height)), [f"{note}: no side is longer than {max_side} pixels (max_side)"]
