"""Blocks of the photos that a fit leaves out, to judge it by."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmerge.render.photos import Photos
from gsmerge.runtime.threads import parallel_map

BLOCK = 32  # pixels, at most


def training_weights(photos: Photos, share: float, seed: int) -> list[np.ndarray]:
    """Per view ``[h,w]`` float32: 0 on the held-out blocks, 1 elsewhere; every view holds out at least one block."""
    size = max(1, min(BLOCK, min(photos.height, photos.width) // 4))

    def one_view(view: int) -> np.ndarray:
        rows, columns = -(-photos.height // size), -(-photos.width // size)
        random = np.random.default_rng([seed, view])
        blocks = random.random((rows, columns)) < share
        if not blocks.any():
            blocks[random.integers(rows), random.integers(columns)] = rows * columns > 1
        full = np.repeat(np.repeat(~blocks, size, 0), size, 1)[: photos.height, : photos.width]
        return full.astype(np.float32)

    return [one_view(view) for view in range(len(photos))]


def reduced(weights: list[np.ndarray], photos: Photos) -> list[np.ndarray]:
    """The weights of full-size photos for the same photos at half size."""
    return [np.ascontiguousarray(weight[::2, ::2][: photos.height, : photos.width]) for weight in weights]


def holdout_psnr(images: list[np.ndarray], photos: Photos, weights: list[np.ndarray], min_gain: float) -> float:
    """PSNR (dB) of renders on the held-out blocks, exposure of the photos set aside.

    Args:
        images: ``[h,w,3]`` render of every photo.
        photos: The photos.
        weights: ``[h,w]`` 0 on the held-out blocks of each view, 1 elsewhere.
        min_gain: Exposure against the mean, as a factor, from which on it is set aside.
    """
    views = range(len(photos))
    clipped = parallel_map(lambda view: np.clip(images[view], 0, 1), views)
    gains = exposure_gains(clipped, photos.images, weights, min_gain)

    def one_view(view: int) -> tuple[float, float]:
        error = ((clipped[view] * gains[view] - photos.images[view]) ** 2).sum(-1)
        mask = weights[view] == 0
        return float(error[mask].sum(dtype=np.float64)), float(mask.sum())

    error, count = np.sum(parallel_map(one_view, views), axis=0)
    return float(-10 * np.log10(max(error / max(3 * count, 1), 1e-12)))


def exposure_gains(
    images: Sequence[np.ndarray],
    photos: np.ndarray,
    weights: Sequence[np.ndarray],
    min_gain: float,
    max_gain: float = 2.0,
) -> np.ndarray:
    """``[v,3]`` float32 factors that bring renders to the photos' exposure, with geometric mean one.

    Least squares on the weighted pixels, per view and channel; ones where no view differs by ``min_gain``.
    """

    def one_view(view: int) -> np.ndarray:
        image, weight = images[view], weights[view][..., None]
        with_photo, with_image = (
            (weight * other * image).sum((0, 1), dtype=np.float64) for other in (photos[view], image)
        )
        return np.clip(with_photo / np.maximum(with_image, 1e-9), 1 / max_gain, max_gain)

    gains = np.stack(parallel_map(one_view, range(len(photos))))
    gains /= np.exp(np.log(gains).mean(0))
    if np.abs(np.log(gains)).max() < np.log(min_gain):
        gains[:] = 1
    return gains.astype(np.float32)
