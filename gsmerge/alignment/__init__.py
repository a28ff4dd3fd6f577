"""Find the pixel that each row of a file belongs to, and estimate cameras; the door: modules in here are private."""

# ruff: noqa: F401  names for other packages

from gsmerge.alignment.cameras import estimate_cameras, move_cameras, other_conventions
from gsmerge.alignment.dropped_depths import guess_depths
from gsmerge.alignment.explain import explain_misalignment, misalignment_error
from gsmerge.alignment.focal import estimate_focal
from gsmerge.alignment.layouts import MAY_BE_UNALIGNED, Layout, fill_from_depths
from gsmerge.alignment.photos_alone import WITH_PHOTOS, estimate_with_photos
from gsmerge.alignment.recovery import Recovery
from gsmerge.alignment.rotations import QUATS, QuatChoice, choose_rotations, read_rotations
from gsmerge.alignment.score import Alignment, check_alignment, check_pairs, sample_pixels
from gsmerge.alignment.search import AlignmentResult, align
from gsmerge.alignment.unaligned import check_cameras, choose_poses, find_padding
