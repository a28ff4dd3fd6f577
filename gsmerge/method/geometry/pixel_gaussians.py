"""Gaussians on the rays of pixels, which fill holes."""

from __future__ import annotations

import numpy as np

from gsmerge.method.geometry.transforms import rgb_to_sh0
from gsmerge.method.kernels.matrices import invert, matmul
from gsmerge.types import Gaussians

# standard deviation in pixels, and opacity, of a new Gaussian
NEW_SIZE_PIXELS = 0.75
NEW_OPACITY = 0.9


def pixel_rays(mask: np.ndarray, K: np.ndarray, viewmat: np.ndarray) -> np.ndarray:
    """Return the vectors ``[n,3]``, in the world, from a camera to depth 1 on the rays of the pixels of ``mask``."""
    y, x = np.nonzero(mask)
    pixels = np.stack([x + 0.5, y + 0.5, np.ones(len(x))], 1)
    return matmul(matmul(pixels, invert(K).T), viewmat[:3, :3])


def make_round_gaussians(
    eye: np.ndarray, rays: np.ndarray, depths: np.ndarray, size: float, colors: np.ndarray, num_higher: int
) -> Gaussians:
    """Make round Gaussians at ``depths [n]`` along ``rays [n,3]`` from ``eye``, with ``colors [n,3]`` (sRGB).

    ``size`` is the standard deviation of a Gaussian at depth 1, ``num_higher`` the number of harmonics above degree 0.
    """
    return Gaussians(
        means=(eye + depths[:, None] * rays).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (len(rays), 1)),
        scales=np.repeat((size * depths)[:, None], 3, 1).astype(np.float32),
        opacities=np.full(len(rays), NEW_OPACITY, np.float32),
        sh0=rgb_to_sh0(colors)[:, None].astype(np.float32),
        shN=np.zeros((len(rays), num_higher, 3), np.float32),
    )
