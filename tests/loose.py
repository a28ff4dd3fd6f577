"""Made scenes whose Gaussians are in no order of pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gsmerge import Cameras, Gaussians, PixelScene, UnalignedScene

NO_CAMERAS = Cameras(torch.empty(0, 4, 4, dtype=torch.float64), torch.empty(0, 3, 3, dtype=torch.float64), 1, 1)


def loosened(scene: PixelScene, order: Tensor | None = None) -> UnalignedScene:
    """The same Gaussians without their order."""
    gaussians = scene.gaussians if order is None else scene.gaussians[order]
    return UnalignedScene(gaussians, scene.cameras, scene.images, scene.names)


def shuffled(scene: PixelScene, seed: int = 0) -> UnalignedScene:
    """In a random order."""
    order = torch.randperm(len(scene.gaussians), generator=torch.Generator().manual_seed(seed))
    return loosened(scene, order)


def voxels(scene: PixelScene, size: float) -> UnalignedScene:
    """One Gaussian per occupied cell: the means of what it holds."""
    g = scene.gaussians
    cells = np.floor(g.means.double().numpy() / size).astype(np.int64)
    _, inverse = np.unique(cells, axis=0, return_inverse=True)
    index = torch.from_numpy(inverse.reshape(-1))
    count = int(index.max()) + 1
    share = 1 / torch.bincount(index, minlength=count).double()

    def mean(values: Tensor) -> Tensor:
        sums = torch.zeros(count, *values.shape[1:], dtype=torch.float64).index_add_(0, index, values.double())
        return sums * share.reshape(-1, *[1] * (values.ndim - 1))

    merged = Gaussians(*(mean(t).float() for t in vars(g).values()))
    merged = replace(merged, quats=torch.nn.functional.normalize(merged.quats, dim=1))
    return UnalignedScene(merged, scene.cameras, scene.images, scene.names)


def far_behind(gaussians: Gaussians, count: int) -> Gaussians:
    """Some of the Gaussians, put where no camera of :func:`scenes.arc` looks."""
    some = gaussians[:count]
    return replace(some, means=some.means - torch.tensor([0.0, 0.0, 30.0]))
