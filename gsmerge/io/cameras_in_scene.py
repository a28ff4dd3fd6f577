"""Where to look at Gaussians from: the cameras of a file, moved to where the Gaussians say that they stand."""

from __future__ import annotations

from dataclasses import dataclass

from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import CameraFile, to_cameras
from gsmerge.io.formats.ply import PlyScene, ply_notes
from gsmerge.io.hints import AUTO, ReadHints
from gsmerge.io.scene import SceneLoad, Views, align_scene
from gsmerge.io.scene_files import SceneFiles
from gsmerge.io.views import cameras_of, read_photos
from gsmerge.types import Gaussians, PixelScene


@dataclass(frozen=True)
class Placed:
    """Gaussians and views of one frame.

    Args:
        gaussians: The file's, with rotations read as the scene has them.
        views: Of the camera file.
        notes: What was adapted or looks odd, one sentence each, without a full stop.
    """

    gaussians: Gaussians
    views: Views
    notes: tuple[str, ...]


def place_views(ply: PlyScene, files: SceneFiles, *, hints: ReadHints = AUTO, photos: bool = True) -> Placed:
    """Views in the frame of the Gaussians, where their pixels or colours tell it; otherwise as their file has them.

    Args:
        ply: The Gaussians.
        files: Where the cameras and photos are.
        hints: What is told instead of found.
        photos: Whether photos that cannot be read are an error; otherwise it is done without them.

    Raises:
        SceneError: If there are no cameras, or they have no size.
    """
    camera_file = cameras_of(ply, files)
    load = _aligned(ply, files, camera_file, hints, photos=True)
    if load is None and not photos:
        load = _aligned(ply, files, camera_file, hints, photos=False)
    if load is not None and isinstance(load.scene, PixelScene):
        return Placed(load.scene.file_gaussians, load.views, load.notes)
    if load is not None:
        return Placed(load.scene.gaussians, load.views, load.notes[:-1])  # but for the one that there are no pixels
    images = read_photos(files, camera_file) if photos else None
    size = None if images is None else (images.shape[2], images.shape[1])
    cameras = to_cameras(camera_file, size)
    views = Views(cameras, images, camera_file.names, tuple(range(len(cameras))))
    note = "the cameras do not fit the Gaussians and stand as their file has them"
    return Placed(ply.gaussians, views, (*ply_notes(ply.info), note))


def _aligned(
    ply: PlyScene, files: SceneFiles, camera_file: CameraFile, hints: ReadHints, *, photos: bool
) -> SceneLoad | None:
    try:
        return align_scene(ply, files, camera_file, hints=hints, photos=photos)
    except SceneError:
        return None
