"""These Gaussians belong to no scene."""

from __future__ import annotations

import numpy as np

from gsmerge import Gaussians
from gsmerge.method.geometry.transforms import normalize


def some(count: int, seed: int = 0, degree: int = 1) -> Gaussians:
    """Return random Gaussians about the origin, of any shape, opacity and colour."""
    rng = np.random.default_rng(seed)
    columns = (
        rng.normal(size=(count, 3)),
        normalize(rng.normal(size=(count, 4))),
        rng.uniform(0.01, 0.11, (count, 3)),
        rng.uniform(0.05, 0.95, count),
        rng.normal(size=(count, 1, 3)),
        rng.normal(size=(count, (degree + 1) ** 2 - 1, 3)),
    )
    return Gaussians(*(column.astype(np.float32) for column in columns))
