"""Describe how far cameras were moved, for reports and notes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gsmerge.geometry import pose_changes


def list_moves(names: Sequence[str], start: np.ndarray, end: np.ndarray, depth: float) -> list[dict[str, Any]]:
    """List for each view its name, the degrees it turned, and the shift of its centre as a share of ``depth``.

    ``start`` and ``end`` are viewmats ``[v,4,4]``; ``depth`` is that of the scene, in their unit.
    """
    degrees, distances = pose_changes(start, end)
    shifts = distances / depth if depth > 0 else distances
    return [
        {"view": name, "degrees": round(turn, 4), "shift": round(shift, 6)}
        for name, turn, shift in zip(names, degrees.tolist(), shifts.tolist(), strict=True)
    ]


def describe_moves(moves: Sequence[dict[str, Any]]) -> str:
    """Describe the mean and the largest of some moves."""
    turns, shifts = ([move[key] for move in moves] for key in ("degrees", "shift"))
    mean, most = (f"{f(turns):.2g} degrees and {100 * f(shifts):.2g} % of the depth" for f in (np.mean, max))
    return f"{mean} on average, {most} at most"
