"""The stand-in for gsplat."""

from __future__ import annotations

from fake_gsplat import fake_gsplat

__all__ = ["fake_gsplat"]
