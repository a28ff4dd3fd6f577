"""These made scenes have Gaussians in no order of pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge import Gaussians, Scene
from gsmerge.method.geometry.transforms import normalize


def without_order(scene: Scene, order: np.ndarray | None = None) -> Scene:
    """Return the same Gaussians without their order."""
    gaussians = scene.gaussians if order is None else scene.gaussians[order]
    return Scene(gaussians, scene.cameras, scene.images, None, scene.names)


def shuffled(scene: Scene, seed: int = 0) -> Scene:
    """Return the Gaussians in a random order."""
    return without_order(scene, np.random.default_rng(seed).permutation(len(scene.gaussians)))


def voxels(scene: Scene, size: float) -> Scene:
    """Return one Gaussian per occupied cell: the means of what it holds."""
    g = scene.gaussians
    cells = np.floor(g.means / size).astype(np.int64)
    _, inverse = np.unique(cells, axis=0, return_inverse=True)
    index = inverse.reshape(-1)
    sizes = np.bincount(index)

    def mean(values: np.ndarray) -> np.ndarray:
        sums = np.zeros((len(sizes), *values.shape[1:]))
        np.add.at(sums, index, values)
        return (sums / sizes.reshape(-1, *[1] * (values.ndim - 1))).astype(np.float32)

    merged = Gaussians(*(mean(values) for values in vars(g).values()))
    merged = replace(merged, quats=normalize(merged.quats))
    return Scene(merged, scene.cameras, scene.images, None, scene.names)


def far_behind(gaussians: Gaussians, count: int) -> Gaussians:
    """Return some of the Gaussians, put where no camera of :func:`scenes.arc` looks."""
    some = gaussians[:count]
    return replace(some, means=some.means - np.array([0, 0, 30], some.means.dtype))
