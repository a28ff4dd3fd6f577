"""Find cameras that show Gaussians in their place, the pixel of each row, and estimate cameras; modules are private.

``rows_first`` takes files that are plain, or leads the search: by layouts of as many rows (``layouts``) at a size that
cameras and photos can have (``grids``), whose views ``match`` finds among the file's cameras, in which of the
``frames``; by ``centres`` of pixels; and by the grid that rows show (``row_grid``). ``score`` measures readings,
``judge`` takes one, and ``explain`` says why none fits. ``cameras`` reads or moves poses, ``unaligned`` chooses those
of rows without pixels, ``upright`` those of rows in a frame that no file has, ``estimate`` (with ``dropped_rows``) and
``focal`` solve for cameras. What few files need loads at first use.
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
    from gsmerge.alignment.doubted_depths import choose_depths
    from gsmerge.alignment.dropped_depths import fill_from_depths
    from gsmerge.alignment.estimate import estimate_cameras, estimate_from_rows
    from gsmerge.alignment.explain import explain_misalignment, misalignment_error
    from gsmerge.alignment.focal import estimate_focal
    from gsmerge.alignment.unaligned import check_cameras, choose_poses

_LATER = {
    "cameras": ("move_cameras", "other_conventions"),
    "doubted_depths": ("choose_depths",),
    "dropped_depths": ("fill_from_depths",),
    "estimate": ("estimate_cameras", "estimate_from_rows"),
    "explain": ("explain_misalignment", "misalignment_error"),
    "focal": ("estimate_focal",),
    "unaligned": ("check_cameras", "choose_poses"),
}
_HOMES = {name: home for home, names in _LATER.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
