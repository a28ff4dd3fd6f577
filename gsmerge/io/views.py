"""The cameras and photos of a scene, wherever they are."""

from __future__ import annotations

import os
from pathlib import Path

from torch import Tensor

from gsmerge.errors import SceneError
from gsmerge.io.alignment.crop import stretch
from gsmerge.io.alignment.grid import Photos, photo_size
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.cameras.estimate import estimate_cameras
from gsmerge.io.cameras.re10k import SUFFIX as CHUNK
from gsmerge.io.cameras.read import CAMERA_PLACES, read_cameras
from gsmerge.io.cameras.sharp import SOURCE as SHARP
from gsmerge.io.cameras.sharp import read_sharp
from gsmerge.io.formats.ply import PlyScene
from gsmerge.io.photos import as_tensor, decode_images, find_image, image_size, list_images
from gsmerge.io.scene_files import SceneFiles


def cameras_of(ply: PlyScene, files: SceneFiles) -> CameraFile:
    """The cameras: from their file, from the ``.ply`` itself, or estimated for the images where there is nothing else.

    Raises:
        SceneError: If there are none and they cannot be estimated.
    """
    if files.cameras is not None:
        return read_cameras(files.cameras, scene=files.ply.stem)
    found = read_sharp(files.ply)
    if found is None and files.images is not None and files.images.is_dir():
        paths = list_images(files.images)
        width, height = image_size(paths[0]) if paths else (0, 0)
        names = [path.relative_to(files.images).as_posix() for path in paths]
        found = estimate_cameras(files.ply, ply.gaussians, ply.valid.numpy(), names, width, height)
    if found is None:
        places = ", ".join(place for place in CAMERA_PLACES if len(place) > 1)
        raise SceneError(
            files.ply,
            f"no cameras found beside it (looked for {places}, one .torch chunk)",
            "name them with --cameras, or have views placed with --order none",
        )
    return found


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
    return stretch((photos[0].shape[1], photos[0].shape[0]), size).photos(photos)


def _stored_photos(files: SceneFiles, camera_file: CameraFile) -> Photos | None:
    if files.images is None:
        folder = Path(camera_file.path).parent
        found = [find_image(folder, name) for name in camera_file.names]
        paths = [f for f in found if f is not None]
        return decode_images(paths, camera_file.names) if len(paths) == len(found) else None
    if files.images.suffix not in (".npz", CHUNK):
        return decode_images(files.images, camera_file.names)
    own = files.cameras is not None and os.path.realpath(files.cameras) == os.path.realpath(files.images)
    stored = (camera_file if own else read_cameras(files.images, scene=files.ply.stem)).images
    if own and stored is None and files.images.suffix == CHUNK:
        return None
    if stored is None or len(stored) != len(camera_file):
        found_count = 0 if stored is None else len(stored)
        raise SceneError(files.images, f"expected {len(camera_file)} images, one per camera, found {found_count}")
    return stored
