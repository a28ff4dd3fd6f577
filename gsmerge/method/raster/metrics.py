"""Compute image metrics on sRGB values in [0, 1] of arrays or tensors, and describe them in messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gsmerge.arrays import Array, as_array
from gsmerge.method.kernels.elementary import log10
from gsmerge.method.kernels.pictures import compare_windows

# side of the windows of SSIM and their standard deviation, pixels
WINDOW = 11
SIGMA = 1.5
INNER = (slice(WINDOW // 2, -(WINDOW // 2)), slice(WINDOW // 2, -(WINDOW // 2)))  # pixels that are centres of windows
# stabilisers of SSIM (K1 = .01, K2 = .03) for a data range of 1
C1 = 0.01**2
C2 = 0.03**2
MAX_LOSS = 0.5  # dB of PSNR that a result may lose against its input without a warning
SAMPLE_LOSS = 1.0  # dB by which a loss measured on a sample may be wrong; at most 0.9 dB on fifteen captures
MAX_PSNR = 120.0  # dB that replace the infinite PSNR of equal pictures
POOR_PSNR = 30.0  # dB of PSNR between a result and its input, below which their views look different


def image_pair(image: Array, reference: Array) -> tuple[Array, Array]:
    """Convert two images ``[h,w,c]`` to arrays, or raise ValueError if their shapes differ."""
    first = as_array(image)
    second = as_array(reference)
    if first.ndim != 3 or first.shape != second.shape:
        raise ValueError(f"expected two images [h,w,c] of one shape, got {list(first.shape)} and {list(second.shape)}")
    return first, second


def pixel_mask(mask: Array, image: Array) -> Array:
    """Convert a mask to ``[h,w]`` bool, or raise ValueError if it is empty or has another size than the image."""
    selected = as_array(mask).astype(bool)
    if selected.ndim == 3 and selected.shape[2] == 1:
        selected = selected[..., 0]
    if selected.shape != image.shape[:2]:
        raise ValueError(f"mask: expected shape {list(image.shape[:2])}, got {list(selected.shape)}")
    if not selected.any():
        raise ValueError("mask: expected at least one pixel, got none")
    return selected


def psnr(image: Array, reference: Array, mask: Array | None = None) -> float:
    """Return the PSNR (dB) of images ``[h,w,c]`` in [0, 1], within ``mask [h,w]`` if given."""
    return psnr_within(image, reference, [mask])[0]


def psnr_within(image: Array, reference: Array, masks: Sequence[Array | None]) -> list[float]:
    """Return the :func:`psnr` (dB) within each of the ``masks [h,w]``, where None stands for all pixels."""
    first, second = image_pair(image, reference)
    checked = [None if mask is None else pixel_mask(mask, first) for mask in masks]
    pairs = ((_select(first, mask), _select(second, mask)) for mask in checked)
    errors = [float((np.subtract(*pair, dtype=np.float64) ** 2).mean()) for pair in pairs]
    return [-10 * float(log10(error)) if error > 0 else float("inf") for error in errors]


def _select(values: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """Return the values ``[m,c]`` of the pixels in ``mask [h,w]``, or all values ``[h,w,c]`` without a mask."""
    # compress takes a third of the time that indexing by a mask takes
    return values if mask is None else values.reshape(-1, values.shape[2]).compress(mask.reshape(-1), 0)


def decibels(error: float) -> float:
    """Convert a mean squared error of values in [0, 1] to a PSNR (dB) of at most 120."""
    return -10 * float(log10(max(error, 1e-12)))


def psnr_words(psnr: float) -> str:
    """Describe a PSNR (dB) in words."""
    return "no difference" if psnr >= MAX_PSNR else f"{psnr:.1f} dB"


def psnr_figure(psnr: float, choices: Mapping[str, object]) -> str:
    """Write the PSNR (dB) of a scene's input views for a message.

    If the ``choices`` of a report say that all views were scored, the PSNR has two decimals, otherwise it is an
    estimate.
    """
    return f"{psnr:.2f} dB" if choices.get("scored_all") else f"about {psnr:.1f} dB"


def is_worse(before: float | None, after: float | None, spare: float = 0.0) -> bool:
    """Return whether a PSNR (dB) falls by more than ``MAX_LOSS - spare``, or False if one of the two is None."""
    # Two infinite PSNRs are no loss either, because their difference is NaN
    return before is not None and after is not None and before - after > MAX_LOSS - spare


def describe_loss(name: str, before: float | None, after: float | None, pictures: str) -> str | None:
    """Describe a loss of quality on the scene's ``pictures``, or return None if the loss is at most ``MAX_LOSS``.

    ``before`` and ``after`` are the PSNR (dB) of the pictures from the input and from the result, or None.
    """
    if before is None or after is None or not is_worse(before, after):
        return None
    return f"{name} shows {pictures} worse than the input does: {after:.2f} dB, {before:.2f} dB before"


def describe_distance(psnr: float | None) -> str | None:
    """Describe that a result looks different from its input, or return None if ``psnr`` is at least ``POOR_PSNR``."""
    if psnr is None or psnr >= POOR_PSNR:
        return None
    return f"the result looks different from its input: {psnr:.1f} dB, below {POOR_PSNR:g} dB"


def ssim(image: Array, reference: Array, mask: Array | None = None) -> float:
    """Return the structural similarity, at most 1, over Gaussian windows of 11 x 11 pixels (Wang 2004).

    The result is the mean over channels and over the windows that lie wholly inside the image, as computed by
    scikit-image's ``structural_similarity(gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
    channel_axis=-1, data_range=1)``. The function ``ssim`` is for measuring only. The loss of the full fit and of
    training has its own definition, :func:`gsmerge.research.training.losses.loss_ssim`.

    Images are ``[h,w,c]`` with at most 4 channels. ``mask [h,w]`` selects windows by their centres, but a window also
    contains the pixels around its centre. Raises ValueError if shapes differ, the image is too small or no window is
    selected.
    """
    first, second = image_pair(image, reference)
    if min(first.shape[:2]) < WINDOW:
        raise ValueError(f"expected at least {WINDOW} x {WINDOW} pixels, got {list(first.shape[:2])}")
    (similarity,) = ssim_within(first, second, [mask])
    if similarity is None:
        raise ValueError("mask: expected at least one pixel that is the centre of a window, got none")
    return similarity


def ssim_within(image: Array, reference: Array, masks: Sequence[Array | None]) -> list[float | None]:
    """Return the :func:`ssim` within each of the ``masks [h,w]``, where None stands for all pixels.

    A result is None if the image is smaller than a window, or a mask contains no centre of a window. The images are
    compared once for all masks.
    """
    first, second = image_pair(image, reference)
    if min(first.shape[:2]) < WINDOW:
        return [None] * len(masks)
    similarities = compare_windows(first, second, SIGMA, WINDOW, C1, C2)
    inner = [None if mask is None else pixel_mask(mask, first)[INNER] for mask in masks]
    return [
        float(_select(similarities, mask).mean(dtype=np.float64)) if mask is None or mask.any() else None
        for mask in inner
    ]
