"""Depth Anything 3: border and far pixels dropped, cameras of the nested model in another unit.

Its rotations are used by its own renderer as they are stored, so they are never read in another way.
"""

from __future__ import annotations

from gsmerge.io.exporters.exporter import Exporter

DA3 = Exporter(
    name="da3",
    title="Depth Anything 3",
    opacity="logit",
    order="view-major",
    kinds=("box+depth", "box", "pruned"),
    frames=("same", "scaled", "shifted", "other"),
    check_rotations=False,
    cameras=("DA3 npz", "COLMAP binary", "COLMAP text"),
)
