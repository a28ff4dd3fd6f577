"""Blocks of the photos that a fit does not look at, to judge it by."""

from __future__ import annotations

import numpy as np

from gsmerge.photos import Photos
from gsmerge.threads import parallel_map

BLOCK = 32  # pixels, at most


def training_weights(photos: Photos, share: float, seed: int) -> list[np.ndarray]:
    """Per view ``[h,w]`` float32: 0 on the held-out blocks, 1 elsewhere; every view holds out at least one block."""
    size = max(1, min(BLOCK, min(photos.height, photos.width) // 4))

    def one_view(view: int) -> np.ndarray:
        rows, columns = -(-photos.height // size), -(-photos.width // size)
        random = np.random.default_rng([seed, view])
        held = random.random((rows, columns)) < share
        if not held.any():
            held[random.integers(rows), random.integers(columns)] = rows * columns > 1
        full = np.repeat(np.repeat(~held, size, 0), size, 1)[: photos.height, : photos.width]
        return full.astype(np.float32)

    return [one_view(view) for view in range(len(photos))]


def reduced(weights: list[np.ndarray], photos: Photos) -> list[np.ndarray]:
    """The weights of full-size photos for the same photos at half size."""
    return [np.ascontiguousarray(weight[::2, ::2][: photos.height, : photos.width]) for weight in weights]


def holdout_psnr(images: list[np.ndarray], photos: Photos, weights: list[np.ndarray]) -> float:
    """PSNR (dB) of renders on the held-out blocks."""

    def one_view(view: int) -> tuple[float, float]:
        error = ((np.clip(images[view], 0, 1) - photos.images[view]) ** 2).sum(-1)
        held = weights[view] == 0
        return float(error[held].sum(dtype=np.float64)), float(held.sum())

    error, count = np.sum(parallel_map(one_view, range(len(photos))), axis=0)
    return float(-10 * np.log10(max(error / max(3 * count, 1), 1e-12)))
