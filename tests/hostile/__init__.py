"""The table of hostile inputs: what careless or malicious files may hold, and what has to come of it.

Read by ``tests/e2e/test_hostile_input.py`` and ``benchmarks/hostile.py``. ``changes`` makes further ones at random of
sound files; ``gsm_files`` damages states.
"""

from __future__ import annotations

from . import array_files, camera_files, camera_models, chunks, glb_files, packed_files, pictures, places, ply_files
from .array_files import MARKER
from .case import Case

CASES: dict[str, Case] = {
    **ply_files.CASES,
    **glb_files.CASES,
    **packed_files.CASES,
    **camera_files.CASES,
    **camera_models.CASES,
    **array_files.CASES,
    **chunks.CASES,
    **pictures.CASES,
    **places.CASES,
}

__all__ = ["CASES", "MARKER", "Case"]
