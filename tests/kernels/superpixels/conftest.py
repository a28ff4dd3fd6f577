"""A small picture cut into regions, and the error that superpixels minimise."""

from __future__ import annotations

import numpy as np
import pytest

from gsmerge.kernels.superpixels import seeds


@pytest.fixture
def pixels() -> np.ndarray:
    return np.random.default_rng(3).random((17, 23, 3), dtype=np.float32)


@pytest.fixture
def labels(pixels: np.ndarray) -> np.ndarray:
    """30 connected regions of the picture, not padded."""
    height, width, _ = pixels.shape
    return seeds.voronoi(seeds.hexagonal_seeds(height, width, 30), height, width)
