"""From files to a scene whose Gaussians are in no order of pixels."""

from __future__ import annotations

import os

import torch

from gsmerge.io.cameras.camera_file import to_cameras
from gsmerge.io.cameras.read import read_cameras
from gsmerge.io.ply import OpacityChoice, read_ply
from gsmerge.io.scene import read_photos
from gsmerge.io.scene_files import find_scene_files
from gsmerge.types import Cameras, LooseScene


def read_loose_scene(
    path: str | os.PathLike[str],
    *,
    cameras: str | os.PathLike[str] | None = None,
    images: str | os.PathLike[str] | None = None,
    opacity: OpacityChoice = "auto",
) -> LooseScene:
    """Read Gaussians in any order, with the cameras and images that are found or named, if there are any.

    Args:
        path: The ``.ply``, or a folder that has it.
        cameras: Camera file or folder; None looks beside the ``.ply``.
        images: Folder of images, or an ``.npz`` that holds them; None looks beside the ``.ply``.
        opacity: How opacities are stored; see :func:`gsmerge.io.read_ply`.

    Raises:
        SceneError: If a file is damaged, or a named one is missing.
    """
    files = find_scene_files(path, cameras=cameras, images=images)
    ply = read_ply(files.ply, opacity=opacity)
    gaussians = ply.gaussians[ply.valid]
    if files.cameras is None:
        none = Cameras(torch.empty(0, 4, 4, dtype=torch.float64), torch.empty(0, 3, 3, dtype=torch.float64), 1, 1)
        return LooseScene(gaussians, none, None, ())
    camera_file = read_cameras(files.cameras)
    photos = read_photos(files, camera_file)
    size = None if photos is None else (photos.shape[2], photos.shape[1])
    return LooseScene(gaussians, to_cameras(camera_file, size), photos, camera_file.names)
