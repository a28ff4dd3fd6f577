"""Align rows with cameras: find the pixel of each row, and the cameras that show the Gaussians in place.

``rows_first`` leads. It takes rows in plain order as the pixels of their cameras (``poses`` reads poses in other
conventions and moves inexact cameras), follows rows of which some are missing (``dropped_rows``) in each frame of
exporters (``frames``), and else chooses cameras alone: ``unaligned`` by the photos' colours, and ``upright`` for rows
in a frame that no file stores. ``grids`` are the sizes that cameras and photos can have. ``estimate`` solves for
cameras that no file gives, and ``explain`` reports why rows do not fit. Modules are private; those that few files need
are loaded at first use.
"""

# ruff: noqa: F401  names for other packages

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gsmerge.cameras.layouts import ESTIMATED, NO_CAMERAS_USED, TRIMS, Layout
from gsmerge.cameras.rows_first import AlignmentResult, Recovery, align
from gsmerge.cameras.score import Alignment, check_pairs, check_pixels, sample_pixels

if TYPE_CHECKING:
    from gsmerge.cameras.estimate import estimate_cameras
    from gsmerge.cameras.explain import explain_misalignment, misalignment_error
    from gsmerge.cameras.poses import move_cameras, other_conventions
    from gsmerge.cameras.unaligned import check_cameras, choose_poses

_LOADED_LATER = {
    "poses": ("move_cameras", "other_conventions"),
    "estimate": ("estimate_cameras",),
    "explain": ("explain_misalignment", "misalignment_error"),
    "unaligned": ("check_cameras", "choose_poses"),
}
_MODULES = {name: module for module, names in _LOADED_LATER.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
