"""Filter and sample pictures with the same bits on every processor, which OpenCV's functions do not ensure."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsmerge.method.kernels.elementary import exp
from gsmerge.method.kernels.signature import STATUS, declare, f4

SLOPE, SMOOTH = np.array([-1, 0, 1], np.float32), np.array([1, 2, 1], np.float32)  # the two parts of Sobel's filter
Picture = np.ndarray[Any, Any]
ORIENTATIONS = 8  # number of orientations of a picture, as in EXIF tags: four rotations, also of the mirror image


_filter_picture = declare(
    "filter_picture", STATUS, picture=f4("height", "width", "channels"), across=f4("taps_across"), down=f4("taps_down"),
    padded=f4("room", out=True), rows=f4("padded_height", "width", "channels", out=True),
    out=f4("height", "width", "channels", out=True),
)  # fmt: skip


_compare_windows = declare(
    "compare_windows", STATUS, x=f4("height", "width", "channels"), y=f4("height", "width", "channels"),
    taps=f4("size"), c1=f4(), c2=f4(), row=f4("room", out=True),
    across=f4("rows", "height", "inner_width", "channels", out=True),
    means=f4("rows", "inner_width", "channels", out=True),
    out=f4("inner_height", "inner_width", "channels", out=True),
)  # fmt: skip


_sample_picture = declare(
    "sample_picture", STATUS, picture=f4("height", "width", "channels"), x=f4("n"), y=f4("n"),
    out=f4("n", "channels", out=True),
)  # fmt: skip


def convolve(picture: Picture, across: np.ndarray, down: np.ndarray) -> Picture:
    """Return a picture ``[h,w]`` or ``[h,w,c]`` as float32, convolved with two filters of odd lengths.

    ``across`` filters along the rows, and ``down`` filters along the columns. Outside of its borders the picture is
    mirrored, without repeating the border pixels.
    """
    source: Picture = np.ascontiguousarray(picture, np.float32)
    layers = source.reshape(source.shape if source.ndim == 3 else (*source.shape, 1))
    height, width, channels = layers.shape
    taps = [np.ascontiguousarray(values, np.float32) for values in (across, down)]
    padded = np.empty((width + len(taps[0]) - 1) * channels, np.float32)
    rows = np.empty((height + len(taps[1]) - 1, width, channels), np.float32)
    out = np.empty_like(layers)
    _filter_picture(layers, *taps, padded, rows, out)
    return out.reshape(source.shape)


def blur(picture: Picture, sigma: float, size: int | None = None) -> Picture:
    """Return a picture ``[h,w]`` or ``[h,w,c]`` as float32, blurred by a Gaussian of ``sigma`` pixels.

    The filter has an odd number ``size`` of pixels, by default all pixels within four ``sigma``.
    """
    taps = _gaussian_taps(sigma, round(8 * sigma + 1) | 1 if size is None else size)
    return convolve(picture, taps, taps)


def _gaussian_taps(sigma: float, size: int) -> np.ndarray:
    """Return the weights ``[size]`` of a Gaussian of ``sigma`` pixels, whose sum is 1, for an odd ``size``."""
    offsets = np.arange(size) - size // 2
    weights = exp(offsets**2 * (-0.5 / sigma**2))
    return weights / weights.sum()


def compare_windows(first: Picture, second: Picture, sigma: float, size: int, c1: float, c2: float) -> Picture:
    """Return the structural similarity (SSIM) of two pictures ``[h,w,c]`` in [0, 1] within each window.

    The weights of a window of ``size`` pixels per side are a Gaussian of ``sigma`` pixels. The result is float32 of
    shape ``[h-size+1,w-size+1,c]``, because only windows inside the pictures are compared. ``c1`` and ``c2`` are the
    constants that stabilise the quotients of means and of variances.
    """
    # Variances are small differences of large numbers, for which float32 is exact enough if values are centred at 0
    x, y = (np.ascontiguousarray(picture, np.float32) - np.float32(0.5) for picture in (first, second))
    height, width, channels = x.shape
    inner_width = x.shape[1] - size + 1
    row = np.empty(2 * width * channels, np.float32)
    across = np.empty((4, height, inner_width, channels), np.float32)
    means = np.empty_like(across[:, 0])
    out = np.empty_like(across[0, size - 1 :])
    taps = _gaussian_taps(sigma, size).astype(np.float32)
    _compare_windows(x, y, taps, c1, c2, row, across, means, out)
    return out


def sobel(picture: Picture) -> tuple[Picture, Picture]:
    """Return Sobel's derivatives of a picture to the right and down as float32, eight times the change per pixel."""
    return convolve(picture, SLOPE, SMOOTH), convolve(picture, SMOOTH, SLOPE)


def sample_bilinear(picture: Picture, x: np.ndarray, y: np.ndarray) -> Picture:
    """Return the values ``[...,c]`` float32 of a picture ``[h,w]`` or ``[h,w,c]`` at points, interpolated bilinearly.

    ``x [...]`` and ``y [...]`` are in pixels, with the centre of the top-left pixel at (0, 0). Outside of the picture,
    its border pixels are repeated.
    """
    source: Picture = np.ascontiguousarray(picture, np.float32)
    layers = source.reshape(source.shape if source.ndim == 3 else (*source.shape, 1))
    x = np.ascontiguousarray(x, np.float32)
    y = np.ascontiguousarray(y, np.float32)
    out = np.empty((x.size, layers.shape[2]), np.float32)
    _sample_picture(layers, x.reshape(-1), y.reshape(-1), out)
    return out.reshape(*x.shape, *source.shape[2:])


def enlarge(picture: Picture, width: int, height: int, *, periodic: bool = False) -> Picture:
    """Return a picture ``[h,w]`` or ``[h,w,c]`` in a larger size, as float32, by cubic convolution.

    Outside of the picture, its border pixels are repeated. If ``periodic`` is true, the whole picture is repeated.
    """
    out: Picture = np.asarray(picture, np.float32)
    for axis, size in ((0, height), (1, width)):
        old = out.shape[axis]
        centres = (np.arange(size) + 0.5) * (old / size) - 0.5  # centres of the new pixels, in old pixels
        # The four old pixels around each new pixel, and their weights. At the ends of a line, indices may be below 0 or
        # above the last pixel
        floors = np.floor(centres).astype(np.int64)
        taps = np.arange(-1, 3)[:, None]
        distances = np.abs(centres - floors - taps)
        a = -0.75  # slope parameter of the cubic convolution (Keys 1981), the same as in OpenCV
        inner = ((a + 2) * distances - (a + 3)) * distances * distances + 1
        outer = ((a * distances - 5 * a) * distances + 8 * a) * distances - 4 * a
        weights = np.where(distances <= 1, inner, outer).astype(np.float32)
        ids = (floors + taps) % old if periodic else (floors + taps).clip(0, old - 1)
        shape = [-1 if i == axis else 1 for i in range(out.ndim)]
        terms = [out.take(tap, axis) * weight.reshape(shape) for tap, weight in zip(ids, weights, strict=True)]
        out = terms[0] + terms[1] + terms[2] + terms[3]
    return out


def turn_picture(picture: Picture, orientation: int) -> Picture:
    """Turn a stored picture ``[h,w,...]`` as its ``orientation`` from 0 to 7 says.

    For an orientation of 4 or more, the picture is first mirrored left to right. Every picture is then rotated
    counterclockwise by ``orientation % 4`` quarter turns.
    """
    return np.rot90(picture[:, ::-1] if is_mirrored(orientation) else picture, orientation % (ORIENTATIONS // 2))


def is_mirrored(orientation: int) -> bool:
    """Return true if an orientation mirrors pictures."""
    return orientation >= ORIENTATIONS // 2


def turn_back(picture: Picture, orientation: int) -> Picture:
    """Undo :func:`turn_picture`."""
    upright = np.rot90(picture, -(orientation % (ORIENTATIONS // 2)))
    return upright[:, ::-1] if is_mirrored(orientation) else upright


def count_bars(image: np.ndarray, spread: float) -> tuple[int, int, int, int]:
    """Return the widths, in pixels, of the bars above, below, left and right in a picture ``[h,w,c]``.

    The values of a bar differ by at most ``spread``. An area that reaches the middle of the picture is no bar, so its
    width is 0.
    """
    counts = []
    for lines in (image, image[::-1], image.swapaxes(0, 1), image.swapaxes(0, 1)[::-1]):
        low = np.inf
        high = -np.inf
        count = 0
        half = len(lines) // 2
        for line in lines[:half]:
            low = min(low, float(line.min()))
            high = max(high, float(line.max()))
            if high - low > spread:
                break
            count += 1
        counts.append(count if count < half else 0)
    above, below, left, right = counts
    return above, below, left, right
