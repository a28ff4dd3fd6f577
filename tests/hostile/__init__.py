"""The table of hostile inputs: files that ask for much memory or time, would run code, or name odd places.

Read by ``tests/e2e/test_hostile_input.py``. What a reader refuses, and in which words, is in its unit test;
``tests/fuzz`` changes sound files at random. ``gsm_files`` damages states.
"""

from __future__ import annotations

from . import array_files, camera_files, camera_models, glb_files, packed_files, pictures, places, ply_files
from .array_files import MARKER
from .case import Case

CASES: dict[str, Case] = {
    **ply_files.CASES,
    **glb_files.CASES,
    **packed_files.CASES,
    **camera_files.CASES,
    **camera_models.CASES,
    **array_files.CASES,
    **pictures.CASES,
    **places.CASES,
}

__all__ = ["CASES", "MARKER", "Case"]
