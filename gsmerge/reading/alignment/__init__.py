"""Align rows with cameras: find the pixel of each row, and the cameras that show the Gaussians in place.

``align_rows`` tries three cases, one after the other. In the first case, each pixel has a row, in order. The test reads
poses in other conventions and moves inexact cameras (``conventions``). In the second case, rows are in the order of the
pixels, but some pixels have no row. The test follows the rows through the pixels (``dropped_rows``), in each frame that
exporters use (``frames``). In the third case, rows have no pixels. Then ``unaligned`` chooses cameras by the colours of
the photos, and ``upright`` solves for cameras if no file stores the frame of the rows.

``grids`` brings cameras and photos to one size. ``dropped_rows`` also solves for the cameras if no file gives them, and
``explain`` reports why rows do not fit. The modules are private.
"""

# ruff: noqa: F401  names for other packages

from gsmerge.reading.alignment.align_rows import AlignmentResult, Recovery, find_pixels
from gsmerge.reading.alignment.conventions import move_cameras, other_conventions
from gsmerge.reading.alignment.dropped_rows import estimate_cameras
from gsmerge.reading.alignment.explain import explain_misalignment, misalignment_error
from gsmerge.reading.alignment.layouts import ESTIMATED, TRIMS, Layout
from gsmerge.reading.alignment.score import Alignment, check_pairs, check_pixels, sample_pixels
from gsmerge.reading.alignment.unaligned import CROPPED, CameraCheck, UnseenError, check_cameras, choose_poses
