"""Scenes that were optimised, not predicted: no row belongs to a pixel."""

from __future__ import annotations

from gsmerge.io.exporters.exporter import Exporter

INRIA = Exporter("inria", "INRIA 3DGS", "logit", "none", degrees=(0, 1, 2, 3), cameras=("INRIA cameras.json",))
NERFSTUDIO = Exporter("nerfstudio", "nerfstudio", "logit", "none", degrees=(0, 1, 2, 3), comment="Nerstudio")
GSPLAT = Exporter("gsplat", "gsplat", "logit", "none", degrees=(0, 1, 2, 3), normals=False)
