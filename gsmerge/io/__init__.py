"""Files: the only place that knows their formats."""

from gsmerge.io.alignment.recover import Recovery
from gsmerge.io.alignment.score import Alignment, check_alignment
from gsmerge.io.atomic import atomic_output
from gsmerge.io.bounds import read_json
from gsmerge.io.cameras import CameraFile, read_cameras, to_cameras
from gsmerge.io.formats.ply import PlyInfo, PlyScene, kept_comments, ply_notes, read_ply
from gsmerge.io.formats.writing import OUTPUT_FORMATS, lost_harmonics, output_format, write_gaussians, write_ply
from gsmerge.io.held_out import HeldOutViews, read_held_out
from gsmerge.io.hints import AUTO, ReadHints
from gsmerge.io.photos import read_images
from gsmerge.io.scene import (
    CamerasInScene,
    SceneLoad,
    align_scene,
    load_files,
    load_scene,
    place_cameras_in_scene,
    read_ply_with_hints,
    read_scene,
)
from gsmerge.io.scene_files import SceneFiles, find_scene_files
from gsmerge.io.views import read_photos

__all__ = [
    "AUTO",
    "OUTPUT_FORMATS",
    "Alignment",
    "CameraFile",
    "CamerasInScene",
    "HeldOutViews",
    "PlyInfo",
    "PlyScene",
    "ReadHints",
    "Recovery",
    "SceneFiles",
    "SceneLoad",
    "align_scene",
    "atomic_output",
    "check_alignment",
    "find_scene_files",
    "kept_comments",
    "load_files",
    "load_scene",
    "lost_harmonics",
    "output_format",
    "place_cameras_in_scene",
    "ply_notes",
    "read_cameras",
    "read_held_out",
    "read_images",
    "read_json",
    "read_photos",
    "read_ply",
    "read_ply_with_hints",
    "read_scene",
    "to_cameras",
    "write_gaussians",
    "write_ply",
]
