"""Read and write files. Other packages of gsmerge know nothing about the formats of files."""

from gsmerge.io.atomic import atomic_output as atomic_output
from gsmerge.io.atomic import atomic_outputs as atomic_outputs
from gsmerge.io.bounds import read_json as read_json
from gsmerge.io.cameras.camera_file import CameraFile as CameraFile
from gsmerge.io.cameras.camera_file import to_cameras as to_cameras
from gsmerge.io.cameras.read_cameras import read_cameras as read_cameras
from gsmerge.io.formats.read_gaussians import GaussianFile as GaussianFile
from gsmerge.io.formats.read_gaussians import file_notes as file_notes
from gsmerge.io.formats.read_gaussians import kept_comments as kept_comments
from gsmerge.io.formats.read_gaussians import read_gaussians as read_gaussians
from gsmerge.io.formats.read_gaussians import read_ply as read_ply
from gsmerge.io.formats.table import OUTPUT_FORMATS as OUTPUT_FORMATS
from gsmerge.io.formats.table import SCENE_SUFFIXES as SCENE_SUFFIXES
from gsmerge.io.formats.table import output_format as output_format
from gsmerge.io.formats.write import limit_notes as limit_notes
from gsmerge.io.formats.write import write_gaussians as write_gaussians
from gsmerge.io.formats.write import write_ply as write_ply
from gsmerge.io.photo_files import read_images as read_images
