"""Files: the only place that knows their formats."""

from gsmerge.io.alignment import Alignment, check_alignment
from gsmerge.io.atomic import atomic_output
from gsmerge.io.bounds import read_json
from gsmerge.io.cameras import CameraFile, read_cameras, to_cameras
from gsmerge.io.images import read_images
from gsmerge.io.placed import Placed, place_views
from gsmerge.io.ply import PlyInfo, PlyScene, kept_comments, ply_notes, read_ply
from gsmerge.io.ply_writer import write_ply
from gsmerge.io.reading import AUTO, Reading
from gsmerge.io.recover import Recovery
from gsmerge.io.scene import SceneLoad, align_scene, load_files, load_scene, read_scene, read_told
from gsmerge.io.scene_files import SceneFiles, find_scene_files
from gsmerge.io.targets import Targets, read_targets
from gsmerge.io.views import read_photos
from gsmerge.io.writing import OUTPUT_FORMATS, lost_harmonics, output_format, write_gaussians

__all__ = [
    "AUTO",
    "OUTPUT_FORMATS",
    "Alignment",
    "CameraFile",
    "Placed",
    "PlyInfo",
    "PlyScene",
    "Reading",
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
    "read_scene",
    "read_targets",
    "read_told",
    "to_cameras",
    "write_gaussians",
    "write_ply",
]
