"""Filter and sample pictures with equal bits on every processor, which OpenCV does not ensure for these operations."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsmerge.kernels.elementary import exp
from gsmerge.kernels.signature import STATUS, declare, f4

SLOPE, SMOOTH = np.array([-1, 0, 1], np.float32), np.array([1, 2, 1], np.float32)  # Sobel's filters
Picture = np.ndarray[Any, Any]
ORIENTATIONS = 8  # of a picture, as in EXIF tags: four quarter turns, and four of the mirror image
CUBIC = -0.75  # slope parameter of the cubic convolution (Keys 1981), OpenCV's


_filter_picture = declare(
    "filter_picture", STATUS, picture=f4("height", "width", "channels"), across=f4("taps_across"), down=f4("taps_down"),
    padded=f4("room", out=True), rows=f4("padded_height", "width", "channels", out=True),
    out=f4("height", "width", "channels", out=True),
)  # fmt: skip


_sample_picture = declare(
    "sample_picture", STATUS, picture=f4("height", "width", "channels"), x=f4("n"), y=f4("n"),
    out=f4("n", "channels", out=True),
)  # fmt: skip


def convolve(picture: Picture, across: np.ndarray, down: np.ndarray) -> Picture:
    """Convolve a picture ``[h,w]`` or ``[h,w,c]`` with two filters of odd lengths, mirrored at its borders; float32.

    ``across`` is the filter along the rows and ``down`` that along the columns. Mirroring does not repeat the border
    pixels.
    """
    source: Picture = np.ascontiguousarray(picture, np.float32)
    layers = source.reshape(source.shape if source.ndim == 3 else (*source.shape, 1))
    height, width, channels = layers.shape
    taps = [np.ascontiguousarray(one, np.float32) for one in (across, down)]
    padded = np.empty((width + len(taps[0]) - 1) * channels, np.float32)
    rows, out = np.empty((height + len(taps[1]) - 1, width, channels), np.float32), np.empty_like(layers)
    _filter_picture(layers, *taps, padded, rows, out)
    return out.reshape(source.shape)


def blur(picture: Picture, sigma: float, size: int | None = None) -> Picture:
    """Blur a picture ``[h,w]`` or ``[h,w,c]`` by a Gaussian of ``sigma`` pixels; float32.

    ``size`` is the odd number of pixels of the filter, by default all within four ``sigma``.
    """
    size = round(8 * sigma + 1) | 1 if size is None else size
    places = np.arange(size) - size // 2
    weights = exp(places**2 * (-0.5 / sigma**2))
    taps = weights / weights.sum()
    return convolve(picture, taps, taps)


def sobel(picture: Picture) -> tuple[Picture, Picture]:
    """Compute Sobel's derivatives of a picture, to the right and down: float32, eight times those per pixel."""
    return convolve(picture, SLOPE, SMOOTH), convolve(picture, SMOOTH, SLOPE)


def sample_bilinear(picture: Picture, x: np.ndarray, y: np.ndarray) -> Picture:
    """Sample a picture ``[h,w]`` or ``[h,w,c]`` bilinearly: float32 of shape ``[...,c]``.

    ``x`` and ``y [...]`` are in pixels, with the top-left pixel's centre at (0, 0). Border pixels are repeated outside.
    """
    source: Picture = np.ascontiguousarray(picture, np.float32)
    layers = source.reshape(source.shape if source.ndim == 3 else (*source.shape, 1))
    places = [np.ascontiguousarray(one, np.float32) for one in (x, y)]
    out = np.empty((places[0].size, layers.shape[2]), np.float32)
    _sample_picture(layers, *(one.reshape(-1) for one in places), out)
    return out.reshape(*places[0].shape, *source.shape[2:])


def enlarge(picture: Picture, width: int, height: int, *, periodic: bool = False) -> Picture:
    """Resize a picture ``[h,w]`` or ``[h,w,c]`` to a larger size in pixels by cubic convolution; float32.

    Border pixels are repeated outside. If ``periodic``, the picture itself is repeated.
    """
    out: Picture = np.asarray(picture, np.float32)
    for axis, size in ((0, height), (1, width)):
        places, weights = _cubic_taps(out.shape[axis], size)
        ids = places % out.shape[axis] if periodic else places.clip(0, out.shape[axis] - 1)
        shape = [-1 if i == axis else 1 for i in range(out.ndim)]
        terms = [out.take(some, axis) * share.reshape(shape) for some, share in zip(ids, weights, strict=True)]
        out = terms[0] + terms[1] + terms[2] + terms[3]
    return out


def _cubic_taps(old: int, new: int) -> tuple[Picture, Picture]:
    """Return the four of ``old`` pixels that each new pixel is interpolated from, and their weights, both ``[4,new]``.

    Pixels may lie outside.
    """
    places = (np.arange(new) + 0.5) * (old / new) - 0.5
    first = np.floor(places).astype(np.int64)
    away = np.abs(places - first - np.arange(-1, 3)[:, None])
    a = CUBIC
    near = ((a + 2) * away - (a + 3)) * away * away + 1
    far = ((a * away - 5 * a) * away + 8 * a) * away - 4 * a
    return first + np.arange(-1, 3)[:, None], np.where(away <= 1, near, far).astype(np.float32)


def turn_picture(picture: Picture, orientation: int) -> Picture:
    """Bring a stored picture ``[h,w,...]`` into its ``orientation``, 0 to 7.

    From 4 on the picture is first mirrored left to right. It is then turned counterclockwise by ``orientation % 4``
    quarters.
    """
    return np.rot90(picture[:, ::-1] if is_mirrored(orientation) else picture, orientation % (ORIENTATIONS // 2))


def is_mirrored(orientation: int) -> bool:
    """Return True if an orientation mirrors pictures."""
    return orientation >= ORIENTATIONS // 2


def turn_back(picture: Picture, orientation: int) -> Picture:
    """Undo :func:`turn_picture`."""
    upright = np.rot90(picture, -(orientation % (ORIENTATIONS // 2)))
    return upright[:, ::-1] if is_mirrored(orientation) else upright


def count_bars(image: np.ndarray, spread: float) -> tuple[int, int, int, int]:
    """Count the lines of the bar of one colour at each border of a picture ``[h,w,c]``: above, below, left, right.

    All values of a bar lie within ``spread``. A bar that reaches the middle of the picture has a count of 0.
    """
    counts = []
    for lines in (image, image[::-1], image.swapaxes(0, 1), image.swapaxes(0, 1)[::-1]):
        low, high, count, most = np.inf, -np.inf, 0, len(lines) // 2
        for line in lines[:most]:
            low, high = min(low, float(line.min())), max(high, float(line.max()))
            if high - low > spread:
                break
            count += 1
        counts.append(count if count < most else 0)
    above, below, left, right = counts
    return above, below, left, right
