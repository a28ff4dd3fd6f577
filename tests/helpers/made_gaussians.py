"""These functions draw random Gaussians before a camera for the tests of kernels."""

from __future__ import annotations

import numpy as np

from gsmerge import Gaussians
from gsmerge.method.kernels import elementary


def random_gaussians(
    n: int, seed: int, *, degree: int = 0, opacity: float = 0.5, size: float = -3.0, jitter: float = 0.9
) -> Gaussians:
    """Draw Gaussians around (0, 0, 3), of all sizes and flatnesses; one in twenty is behind the camera."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(n, 3)) * [0.9, 0.8, 1.0] + [0.0, 0.0, 3.0]
    means[: n // 20, 2] -= 4
    columns = (
        means,
        rng.normal(size=(n, 4)),
        elementary.exp(rng.normal(size=(n, 3)) * jitter + size),
        rng.random(n) ** opacity,
        rng.normal(size=(n, 1, 3)),
        rng.normal(size=(n, (degree + 1) ** 2 - 1, 3)) * 0.2,
    )
    return Gaussians(*(column.astype(np.float32) for column in columns))
