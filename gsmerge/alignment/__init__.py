"""Align rows with cameras: find the pixel of each row, and the cameras that show the Gaussians in place.

``rows_first`` controls the search. It accepts plain files at once, whose rows are the pixels in order. For other files
it tries in turn:

- layouts (``layouts``) that have the right number of rows, at each size that cameras and photos can have (``grids``):
  ``match`` finds the camera of each view, and the frame (``frames``) of the cameras in the world of the Gaussians;
- cameras under which the Gaussians lie on the centres of pixels (``centres``);
- the grid that the rows themselves show (``row_grid``).

``score`` measures how well a layout fits, ``judge`` chooses one, and ``explain`` reports why none fits. ``cameras``
reads poses in other conventions and moves inexact cameras. ``unaligned`` chooses cameras for rows without pixels, and
``upright`` for rows in a frame that no file stores. ``estimate`` (with ``dropped_rows``) and ``focal`` solve for
cameras that no file gives. ``depth_choice`` and ``dropped_depths`` use depth maps. Modules are private; those that few
files need are loaded at first use.
"""

# ruff: noqa: F401  names for other packages

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gsmerge.alignment.judge import Recovery
from gsmerge.alignment.layouts import (
    ESTIMATED,
    MAY_BE_UNALIGNED,
    TRIMS,
    Layout,
    da3_borders,
    dropped_layout,
    move_layout,
)
from gsmerge.alignment.rotations import choose_rotations, read_rotations, w_seems_last
from gsmerge.alignment.rows_first import AlignmentResult, align
from gsmerge.alignment.score import Alignment, check_alignment, check_pairs, check_pixels, sample_pixels

if TYPE_CHECKING:
    from gsmerge.alignment.cameras import move_cameras, other_conventions
    from gsmerge.alignment.depth_choice import choose_depths
    from gsmerge.alignment.dropped_depths import fill_from_depths
    from gsmerge.alignment.estimate import estimate_cameras, estimate_from_rows
    from gsmerge.alignment.explain import explain_misalignment, misalignment_error
    from gsmerge.alignment.focal import estimate_focal
    from gsmerge.alignment.unaligned import check_cameras, choose_poses

_LOADED_LATER = {
    "cameras": ("move_cameras", "other_conventions"),
    "depth_choice": ("choose_depths",),
    "dropped_depths": ("fill_from_depths",),
    "estimate": ("estimate_cameras", "estimate_from_rows"),
    "explain": ("explain_misalignment", "misalignment_error"),
    "focal": ("estimate_focal",),
    "unaligned": ("check_cameras", "choose_poses"),
}
_MODULES = {name: module for module, names in _LOADED_LATER.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
