"""Scenes that were optimised, not predicted: no row belongs to a pixel."""

from __future__ import annotations

from gsmerge.io.dialects.dialect import Dialect

INRIA = Dialect("inria", "INRIA 3DGS", "logit", "none", degrees=(0, 1, 2, 3), cameras=("INRIA cameras.json",))
NERFSTUDIO = Dialect("nerfstudio", "nerfstudio", "logit", "none", degrees=(0, 1, 2, 3), comment="Nerstudio")
GSPLAT = Dialect("gsplat", "gsplat", "logit", "none", degrees=(0, 1, 2, 3), normals=False)
