"""Compile the kernels of the fit: ``python -m gsmerge.stages.fit.warm``.

The command line starts this beside the first run after installation, so that two processors compile: the run begins
with the kernels of segmentation and merging, this with those that come last. Both leave them in the same cache.
"""

from __future__ import annotations

import numpy as np

from gsmerge.geometry import normalize
from gsmerge.render.photos import EPS2D, Photos
from gsmerge.runtime.threads import use_threads
from gsmerge.stages.fit import FitOptions, fit
from gsmerge.types import Gaussians


def compile_fit_kernels() -> None:
    """Fit a handful of Gaussians to grey pictures."""
    count, rng = 24, np.random.default_rng(0)
    gaussians = Gaussians(
        means=rng.random((count, 3), np.float32) + np.array([-0.5, -0.5, 1.5], np.float32),
        quats=normalize(rng.standard_normal((count, 4), np.float32)),
        scales=np.full((count, 3), 0.1, np.float32),
        opacities=np.full(count, 0.5, np.float32),
        sh0=np.zeros((count, 1, 3), np.float32),
        shN=np.zeros((count, 0, 3), np.float32),
    )
    K = np.array([[32.0, 0, 16], [0, 32, 16], [0, 0, 1]])
    photos = tuple(
        Photos(
            np.full((2, size, size, 3), 0.5, np.float32),
            np.tile(np.eye(4), (2, 1, 1)),
            np.tile(K * [[size / 32], [size / 32], [1]], (2, 1, 1)),
            EPS2D * (size / 32) ** 2,
        )
        for size in (32, 16)
    )
    with use_threads(1):
        fit(gaussians, (photos[0], photos[1]), FitOptions(), count=2 * count)


if __name__ == "__main__":
    compile_fit_kernels()
