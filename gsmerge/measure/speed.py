"""Measure the seconds that the renderer takes for a view."""

from __future__ import annotations

import time

from gsmerge.raster import render
from gsmerge.types import Cameras, Gaussians


def time_render(gaussians: Gaussians, view: Cameras, near: float) -> float:
    """Measure the seconds of rendering a view."""
    start = time.perf_counter()
    render(gaussians, view, near=near)
    return time.perf_counter() - start
