"""Image metrics on sRGB values in [0, 1]."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[Any]

WINDOW = 7  # pixels per side of the windows of ssim
C1, C2 = 0.01**2, 0.03**2  # stabilisers of ssim for a data range of 1


def _as_array(image: Array | Tensor) -> Array:
    return image.detach().cpu().numpy() if isinstance(image, Tensor) else np.asarray(image)


def _pair(image: Array | Tensor, reference: Array | Tensor) -> tuple[Array, Array]:
    first, second = _as_array(image), _as_array(reference)
    if first.ndim != 3 or first.shape != second.shape:
        raise ValueError(f"expected two images [h,w,c] of one shape, got {list(first.shape)} and {list(second.shape)}")
    return first, second


def _mask(mask: Array | Tensor, image: Array) -> Array:
    chosen = _as_array(mask).astype(bool)
    if chosen.ndim == 3 and chosen.shape[2] == 1:
        chosen = chosen[..., 0]
    if chosen.shape != image.shape[:2]:
        raise ValueError(f"mask: expected shape {list(image.shape[:2])}, got {list(chosen.shape)}")
    if not chosen.any():
        raise ValueError("mask: expected at least one pixel, got none")
    return chosen


def psnr(image: Array | Tensor, reference: Array | Tensor, mask: Array | Tensor | None = None) -> float:
    """Peak signal-to-noise ratio.

    Args:
        image: ``[h,w,c]``.
        reference: ``[h,w,c]``.
        mask: ``[h,w]`` pixels that count; None: all.

    Returns:
        dB for a data range of 1; infinite for equal images.

    Raises:
        ValueError: If the shapes differ or no pixel counts.
    """
    first, second = _pair(image, reference)
    squares = np.subtract(first, second, dtype=np.float64) ** 2
    error = float(squares.mean() if mask is None else squares[_mask(mask, first)].mean())
    return -10 * float(np.log10(error)) if error > 0 else float("inf")


def ssim(image: Array | Tensor, reference: Array | Tensor, mask: Array | Tensor | None = None) -> float:
    """Structural similarity (Wang et al. 2004) with uniform 7 x 7 windows.

    The mean over the windows that lie wholly inside the image, as scikit-image's ``structural_similarity`` with
    ``channel_axis=2, data_range=1`` computes it.

    Args:
        image: ``[h,w,c]``, at least 7 x 7 pixels.
        reference: ``[h,w,c]``.
        mask: ``[h,w]`` centres of the windows that count; None: all. Windows still see the pixels around.

    Returns:
        At most 1.

    Raises:
        ValueError: If the shapes differ, the image is too small or no window counts.
    """
    first, second = _pair(image, reference)
    if min(first.shape[:2]) < WINDOW:
        raise ValueError(f"expected at least {WINDOW} x {WINDOW} pixels, got {list(first.shape[:2])}")
    border = WINDOW // 2
    inner = slice(border, -border), slice(border, -border)
    chosen = None if mask is None else _mask(_mask(mask, first)[inner], first[inner])
    # In float64: variances are small differences of large numbers.
    x, y = first.astype(np.float64), second.astype(np.float64)

    def mean(values: Array) -> Array:
        blurred = cv2.blur(values, (WINDOW, WINDOW), borderType=cv2.BORDER_REFLECT_101)
        return blurred.reshape(values.shape)[inner]

    ux, uy = mean(x), mean(y)
    unbiased = WINDOW**2 / (WINDOW**2 - 1)
    vx, vy = unbiased * (mean(x * x) - ux * ux), unbiased * (mean(y * y) - uy * uy)
    vxy = unbiased * (mean(x * y) - ux * uy)
    scores = (2 * ux * uy + C1) * (2 * vxy + C2) / ((ux * ux + uy * uy + C1) * (vx + vy + C2))
    return float(scores.mean() if chosen is None else scores[chosen].mean())
