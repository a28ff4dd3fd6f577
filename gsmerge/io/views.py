"""The cameras and photos of a scene, wherever they are, at a size that memory has room for."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

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
    Size,
    as_tensor,
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

    Raises:
        SceneError: If there are none and they cannot be estimated.
    """
    if files.cameras is not None:
        return read_cameras(files.cameras, scene=files.ply.stem)
    cameras = read_sharp(files.ply)
    if cameras is None and files.images is not None and files.images.is_dir():
        paths = list_images(files.images)
        width, height = image_size(paths[0]) if paths else (0, 0)
        names = [path.relative_to(files.images).as_posix() for path in paths]
        cameras = estimate_cameras(files.ply, ply.gaussians, ply.valid.numpy(), names, width, height)
    if cameras is None:
        places = ", ".join(place for place in CAMERA_PLACES if len(place) > 1)
        raise SceneError(
            files.ply,
            f"no cameras found next to it (looked for {places}, one .torch chunk)",
            "name them with --cameras, or have views placed with --order none",
        )
    return cameras


def read_photos(files: SceneFiles, camera_file: CameraFile) -> Tensor | None:
    """The images of the cameras: from the folder, an ``.npz`` or ``.torch``, or where the camera file itself says.

    Args:
        files: Where the images are.
        camera_file: The cameras.

    Returns:
        ``[c,h,w,3]`` float32 in [0, 1], in the order of the cameras; None if there are none.

    Raises:
        SceneError: As :func:`gsmerge.io.read_images`.
    """
    photos = stored_photos(files, camera_file)
    return None if photos is None else as_tensor(photos)


def stored_photos(files: SceneFiles, camera_file: CameraFile) -> Photos | None:
    """:func:`read_photos` as c arrays ``[h,w,3]`` uint8."""
    photos = _stored_photos(files, camera_file)
    size = int(camera_file.widths[0]), int(camera_file.heights[0])
    if photos is None or camera_file.source != SHARP or photo_size(photos) == size:
        return photos
    return resize_to((photos[0].shape[1], photos[0].shape[0]), size).photos(photos)


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
    """Decoded photos at a size that memory has room for; and a note about it.

    Args:
        photos: c uint8 photos of one size.
        rows: Gaussians of the file: where they may be the photos' pixels as they are, the photos stay.
        max_side: Longest side of what does not fit, pixels.
        unaligned: Whether the Gaussians are known to belong to no pixels: then no photo stays larger than that.
    """
    size = photo_size(photos)
    if photos is None or size is None or max(size) <= max_side:
        return photos, []
    pixels = len(photos) * size[0] * size[1]
    if not unaligned and (_FLOAT_PIXEL * pixels <= _MAX_BYTES or 2 * rows > pixels):
        return photos, []
    to = _limit(size, max_side)
    return resize_to(size, to).photos(photos), [_note(size, to, max_side)]


def limit_view_size(cameras: Cameras, images: Tensor | None, max_side: int) -> tuple[Cameras, Tensor | None, list[str]]:
    """Cameras and photos ``[c,h,w,3]`` of unaligned Gaussians, no side longer than ``max_side`` pixels; and a note."""
    size = cameras.width, cameras.height
    if max(size) <= max_side:
        return cameras, images, []
    to = _limit(size, max_side)
    transform = resize_to(size, to)
    smaller = replace(cameras, Ks=transform.intrinsics(cameras.Ks), width=to[0], height=to[1])
    if images is not None:
        images = torch.from_numpy(np.stack(transform.photos(images.numpy())))
    return smaller, images, [_note(size, to, max_side)]


def _limit(size: Size, max_side: int) -> Size:
    scale = min(1.0, max_side / max(size))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def _note(size: Size, to: Size, max_side: int) -> str:
    return (
        f"views of {size[0]} x {size[1]} are worked on at {to[0]} x {to[1]}: no side is longer than {max_side} pixels"
        " (max_side)"
    )
