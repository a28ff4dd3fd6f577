"""Exporters that merge Gaussians in voxels: no row belongs to a pixel."""

from __future__ import annotations

from gsmerge.io.dialects.dialect import Dialect

ANYSPLAT = Dialect("anysplat", "AnySplat", "raw", "none")
WORLDMIRROR = Dialect("worldmirror", "WorldMirror", "raw", "none")
