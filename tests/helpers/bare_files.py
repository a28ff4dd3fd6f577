"""Files of Gaussians beside which nothing lies, and whose rows are no grid."""

from __future__ import annotations

from pathlib import Path

from plyfile import PlyData, PlyElement


def write_without_grid(source: Path, out: Path) -> Path:
    """Write the rows of a ``.ply`` without the last one to a file in a folder that is made; return its path."""
    rows = PlyData.read(str(source))["vertex"].data[:-1].copy()
    out.parent.mkdir(parents=True, exist_ok=True)
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(out))
    return out
