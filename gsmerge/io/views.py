"""The cameras and photos of a scene, wherever they are, at a size that memory has room for."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.alignment.estimate_cameras import estimate_cameras
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.cameras.re10k import SUFFIX as CHUNK
from gsmerge.io.cameras.read import CAMERA_PLACES, read_cameras
from gsmerge.io.cameras.sharp import SOURCE as SHARP
from gsmerge.io.cameras.sharp import read_sharp
from gsmerge.io.formats.ply import PlyScene
from gsmerge.io.photos import (
    Photos,
    PhotoTransform,
    Size,
    decode_images,
    find_image,
    image_size,
    list_images,
    photo_size,
    resize_to,
)
from gsmerge.io.scene_files import SceneFiles
from gsmerge.types import Cameras

_MAX_BYTES = 2 << 30  # of all photos as floats, before it is known whether the Gaussians belong to pixels
_FLOAT_PIXEL = 12  # bytes


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
        raise SceneError(files.ply, problem, "name them with --cameras, or have views placed with --order none")
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
    if files.images is None:
        folder = Path(camera_file.path).parent
        paths = [path for path in (find_image(folder, name) for name in camera_file.names) if path is not None]
        return decode_images(paths, camera_file.names) if len(paths) == len(camera_file) else None
    if files.images.suffix not in (".npz", CHUNK):
        return decode_images(files.images, camera_file.names)
    own = files.cameras is not None and os.path.realpath(files.cameras) == os.path.realpath(files.images)
    stored = (camera_file if own else read_cameras(files.images, scene=files.ply.stem)).images
    if own and stored is None and files.images.suffix == CHUNK:
        return None
    if stored is None or len(stored) != len(camera_file):
        count = 0 if stored is None else len(stored)
        raise SceneError(files.images, f"expected {len(camera_file)} images, one per camera, found {count}")
    return stored


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
    return photos if transform is None else transform.photos(photos), notes


def limit_view_size(
    cameras: Cameras, images: np.ndarray | None, max_side: int
) -> tuple[Cameras, np.ndarray | None, list[str]]:
    """Cameras and photos ``[c,h,w,3]`` of unaligned Gaussians, no side longer than ``max_side`` pixels; and a note."""
    transform, notes = _limit((cameras.width, cameras.height), max_side)
    if transform is not None:
        cameras = transform.cameras(cameras)
        images = None if images is None else np.stack(transform.photos(images))
    return cameras, images, notes


def _limit(size: Size, max_side: int) -> tuple[PhotoTransform | None, list[str]]:
    """What brings pictures to ``max_side``, and a note; None where nothing has to."""
    if max(size) <= max_side:
        return None, []
    scale = max_side / max(size)
    width, height = (max(1, round(side * scale)) for side in size)
    note = f"views of {size[0]} x {size[1]} are worked on at {width} x {height}"
    return resize_to(size, (width, height)), [f"{note}: no side is longer than {max_side} pixels (max_side)"]
