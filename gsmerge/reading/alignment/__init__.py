"""Align rows with cameras: find the pixel of each row, and the cameras that show the Gaussians in place.

``align_rows`` tries three cases, one after the other. In the first case, each pixel has a row, in order. The test reads
poses in other conventions and moves inexact cameras (``conventions``). In the second case, rows are in the order of the
pixels, but some pixels have no row. The test follows the rows through the pixels (``dropped_rows``), in each frame that
exporters use (``frames``). In the third case, rows have no pixels. Then ``unaligned`` chooses cameras by the colours of
the photos, and ``upright`` solves for cameras if no file stores the frame of the rows.

``grids`` brings cameras and photos to one size. ``own_cameras`` solves for the cameras if no file gives them, and
``explain`` reports why rows do not fit. The modules are private. Modules that few files need are loaded at first use.
"""

# ruff: noqa: F401  names for other packages

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gsmerge.reading.alignment.align_rows import AlignmentResult, Recovery, align
from gsmerge.reading.alignment.layouts import ESTIMATED, TRIMS, Layout
from gsmerge.reading.alignment.score import Alignment, check_pairs, check_pixels, sample_pixels

if TYPE_CHECKING:
    from gsmerge.reading.alignment.conventions import move_cameras, other_conventions
    from gsmerge.reading.alignment.explain import explain_misalignment, misalignment_error
    from gsmerge.reading.alignment.own_cameras import estimate_cameras
    from gsmerge.reading.alignment.unaligned import check_cameras, choose_poses

_LOADED_LATER = {
    "conventions": ("move_cameras", "other_conventions"),
    "own_cameras": ("estimate_cameras",),
    "explain": ("explain_misalignment", "misalignment_error"),
    "unaligned": ("check_cameras", "choose_poses"),
}
_MODULES = {name: module for module, names in _LOADED_LATER.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a name of ``_LOADED_LATER`` when it is first used."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
