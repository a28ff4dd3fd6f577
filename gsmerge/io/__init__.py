"""Files: the only place that knows their formats."""

from gsmerge.io.alignment.recover import Recovery
from gsmerge.io.alignment.verify import Alignment, check_alignment
from gsmerge.io.atomic import atomic_output
from gsmerge.io.bounds import read_json
from gsmerge.io.cameras import CameraFile, read_cameras, to_cameras
from gsmerge.io.cameras_in_scene import Placed, place_views
from gsmerge.io.formats.ply import PlyInfo, PlyScene, kept_comments, ply_notes, read_ply
from gsmerge.io.formats.ply_writer import write_ply
from gsmerge.io.formats.writing import OUTPUT_FORMATS, lost_harmonics, output_format, write_gaussians
from gsmerge.io.held_out import Targets, read_targets
from gsmerge.io.hints import AUTO, ReadHints
from gsmerge.io.photos import read_images
from gsmerge.io.scene import SceneLoad, align_scene, load_files, load_scene, read_ply_with_hints, read_scene
from gsmerge.io.scene_files import SceneFiles, find_scene_files
from gsmerge.io.views import read_photos

__all__ = [
    "AUTO",
    "OUTPUT_FORMATS",
    "Alignment",
    "CameraFile",
    "Placed",
    "PlyInfo",
    "PlyScene",
    "ReadHints",
    "Recovery",
    "SceneFiles",
    "SceneLoad",
    "Targets",
    "align_scene",
    "atomic_output",
    "check_alignment",
    "find_scene_files",
    "kept_comments",
    "load_files",
    "load_scene",
    "lost_harmonics",
    "output_format",
    "place_views",
    "ply_notes",
    "read_cameras",
    "read_images",
    "read_json",
    "read_photos",
    "read_ply",
    "read_ply_with_hints",
    "read_scene",
    "read_targets",
    "to_cameras",
    "write_gaussians",
    "write_ply",
]
