"""Fixtures are a small picture and its cut into regions."""

from __future__ import annotations

import numpy as np
import pytest

from gsmerge.method.kernels.superpixels import bass

SIZE = (17, 23)


@pytest.fixture
def pixels() -> np.ndarray:
    return np.random.default_rng(3).random((*SIZE, 3), dtype=np.float32)


@pytest.fixture
def labels() -> np.ndarray:
    """Return 30 connected regions of the picture, not padded."""
    return bass.voronoi(bass.hexagonal_seeds(*SIZE, 30), *SIZE)
