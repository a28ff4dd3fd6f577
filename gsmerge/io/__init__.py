"""Files: the only place that knows their formats."""

from gsmerge.io.alignment import Alignment, check_alignment
from gsmerge.io.atomic import atomic_output
from gsmerge.io.cameras import CameraFile, read_cameras, to_cameras
from gsmerge.io.images import read_images
from gsmerge.io.loose import read_loose_scene
from gsmerge.io.ply import PlyInfo, PlyScene, ply_notes, read_ply
from gsmerge.io.ply_writer import write_ply
from gsmerge.io.scene import SceneLoad, align_scene, load_scene, read_photos, read_scene
from gsmerge.io.scene_files import SceneFiles, find_scene_files

__all__ = [
    "Alignment",
    "CameraFile",
    "PlyInfo",
    "PlyScene",
    "SceneFiles",
    "SceneLoad",
    "align_scene",
    "atomic_output",
    "check_alignment",
    "find_scene_files",
    "load_scene",
    "ply_notes",
    "read_cameras",
    "read_images",
    "read_loose_scene",
    "read_photos",
    "read_ply",
    "read_scene",
    "to_cameras",
    "write_ply",
]
