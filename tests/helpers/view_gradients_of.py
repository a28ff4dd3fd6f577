"""These functions tile the view of the turned camera, and give its gradients row by row."""

from __future__ import annotations

from typing import Any

import numpy as np
from slow_renderer import turned_cameras

from gsmerge import Gaussians
from gsmerge.method.raster import TiledView, make_splats, tile_view


def turned_view(gaussians: Gaussians, **options: Any) -> TiledView:
    cameras = turned_cameras(1).numpy()
    return tile_view(
        make_splats(gaussians), cameras.viewmats[0], cameras.Ks[0], cameras.width, cameras.height, **options
    )


def normal(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def full(gradients: Any, name: str, n: int) -> np.ndarray:
    rows = getattr(gradients, name)
    array = np.zeros((n, *rows.shape[1:]))
    array[gradients.ids] = rows
    return array


def assert_near(actual: np.ndarray, expected: np.ndarray, most: float = 1e-3) -> None:
    assert np.isfinite(actual).all()
    assert np.linalg.norm(actual - expected) <= most * np.linalg.norm(expected) + 1e-9
