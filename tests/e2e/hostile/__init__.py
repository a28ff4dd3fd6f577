"""Hostile inputs, each with a name: what a careless or malicious file may hold."""

from __future__ import annotations

from . import array_files, camera_files, camera_models, chunks, pictures, places, ply_files
from .array_files import MARKER
from .case import Case

CASES: dict[str, Case] = {
    **ply_files.CASES,
    **camera_files.CASES,
    **camera_models.CASES,
    **array_files.CASES,
    **chunks.CASES,
    **pictures.CASES,
    **places.CASES,
}

__all__ = ["CASES", "MARKER", "Case"]
