"""These files of Gaussians have nothing beside them, and their rows are no grid."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement


def write_without_grid(source: Path, out: Path) -> Path:
    """Write the rows of a ``.ply``, sorted and without the last one, to a file in a new folder; return its path."""
    rows = np.sort(PlyData.read(str(source))["vertex"].data, order="x", kind="stable")[:-1].copy()
    out.parent.mkdir(parents=True, exist_ok=True)
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(out))
    return out
