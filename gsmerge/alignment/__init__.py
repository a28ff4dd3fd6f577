"""Find the pixel that each row of a file belongs to, and estimate cameras; the door: modules in here are private.

``search`` yields grids of each size and convention of the poses, ``readings`` reads the rows of one grid: from
``layouts``, or, with pixels missing, from ``ordered_rows`` and ``incomplete``. ``score`` measures readings, ``judge``
chooses one, and ``explain`` says why none fits. ``cameras`` reads or moves poses, ``unaligned`` chooses those of rows
without pixels, ``upright`` those of rows in a frame that no file has, ``estimate`` and ``focal`` solve for cameras.
"""

# ruff: noqa: F401  names for other packages

from gsmerge.alignment.cameras import move_cameras, other_conventions
from gsmerge.alignment.dropped_depths import fill_from_depths, guess_depths
from gsmerge.alignment.estimate import (
    ESTIMATED,
    WITH_PHOTOS,
    estimate_cameras,
    estimate_from_rows,
    estimate_with_photos,
)
from gsmerge.alignment.explain import explain_misalignment, misalignment_error
from gsmerge.alignment.focal import estimate_focal
from gsmerge.alignment.judge import Recovery
from gsmerge.alignment.layouts import MAY_BE_UNALIGNED, TRIMS, Layout
from gsmerge.alignment.rotations import choose_rotations, read_rotations
from gsmerge.alignment.score import Alignment, check_alignment, check_pairs, sample_pixels
from gsmerge.alignment.search import AlignmentResult, align
from gsmerge.alignment.unaligned import check_cameras, choose_poses, find_padding
