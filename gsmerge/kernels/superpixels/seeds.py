"""Measure how much each pixel resembles a corner, choose seeds of superpixels by this, and grow regions from them."""

from __future__ import annotations

import math

import numpy as np

from gsmerge.kernels.signature import STATUS, declare, f4, f8, i4, i8, u1

JITTER = 0.3  # width of the noise on the threshold of dithering, without which seeds would form lines


_corner_response = declare(
    "corner_response", STATUS, pixels=f4("height", "width", 3), planes=f4(4, "height", "stride", out=True),
    response=f4("height", "width", out=True),
)  # fmt: skip


def corner_response(pixels):
    """Return the smaller eigenvalue of the grey picture's structure tensor (Shi and Tomasi), ``[h,w]`` float32.

    The tensor is the mean over 3 x 3 pixels of products of Sobel's derivatives, with the picture mirrored at its
    borders. The result has the scale of OpenCV's function, whose last bits depend on the processor. ``pixels [h,w,3]``
    are float32.
    """
    height, width, _ = pixels.shape
    response = np.empty((height, width), np.float32)
    _corner_response(pixels, np.empty((4, height, width + 2), np.float32), response)
    return response


def hexagonal_seeds(height, width, count):
    """Return the positions (y, x) ``[count,2]`` int64 of different pixels near the points of a hexagonal grid.

    The numbers of points in the rows of the grid differ by at most one.
    """
    row_distance = math.sqrt(height * width / count * math.sqrt(3) / 2)
    num_rows = min(max(round(height / row_distance), math.ceil(count / width)), height, count)
    row_starts = np.arange(num_rows + 1) * count // num_rows
    row = np.repeat(np.arange(num_rows), np.diff(row_starts))
    column, row_length = np.arange(count) - row_starts[row], np.diff(row_starts)[row]
    y = (2 * row + 1) * height // (2 * num_rows)
    x = (column + np.where(row % 2 == 0, 0.25, 0.75)) * width / row_length
    return np.stack([y, x.astype(np.int64)], 1)


def seed_density(saliency, count):
    """Return how many seeds each pixel should get, ``[h,w]`` float64, from 0 to 1 with a sum of ``count``.

    The numbers grow with the root of ``saliency [h,w]``. The numbers of seeds are uniform if the saliency is zero
    everywhere.
    """
    density = np.sqrt(saliency, dtype=np.float64)
    density_floor = 0.3  # share of the seeds that are spread evenly
    density = density_floor + (1 - density_floor) * density / max(density.mean(), 1e-12)
    density *= count / density.sum()
    while (density > 1).any():
        full = density >= 1
        density[full] = 1
        rest = count - np.count_nonzero(full)
        density[~full] *= rest / density[~full].sum() if rest > 0 else 0
    return density


# `errors` are zero before
_dither = declare(
    "dither", STATUS, density=f8("height", "width"), jitter=f8(), errors=f8(2, "columns", out=True),
    seeds=u1("height", "width", out=True),
)  # fmt: skip


def dither(density):
    """Return a mask ``[h,w]`` of seeds by Floyd-Steinberg dithering, in alternating directions and with noise."""
    height, width = density.shape
    seeds = np.empty((height, width), np.uint8)
    _dither(density, JITTER, np.zeros((2, width + 2)), seeds)
    return seeds.view(np.bool_)


def _spread_picks(weights, count):
    """Return ``count`` different indices of weights, ascending, at equal steps of the cumulative sum."""
    total = np.cumsum(weights)
    order = np.arange(count)
    picks = np.searchsorted(total, (order + 0.5) * (total[-1] / count))
    picks = np.maximum.accumulate(picks - order) + order
    return np.minimum(picks, len(weights) - count + order)


def seeds_from_density(density, count):
    """Return the positions (y, x) ``[count,2]`` int64 of different pixels, distributed by their ``density [h,w]``.

    Dithering loses a few seeds at the border of the picture. To get the exact number, seeds are added or removed
    evenly.
    """
    seeds = dither(density).reshape(-1)
    surplus = np.count_nonzero(seeds) - count
    if surplus != 0:
        candidates = np.flatnonzero(seeds == (surplus > 0))
        weights = np.ones(len(candidates)) if surplus > 0 else density.reshape(-1)[candidates] + 1e-9
        seeds[candidates[_spread_picks(weights, abs(surplus))]] = surplus < 0
    return np.stack(np.unravel_index(np.flatnonzero(seeds), density.shape), 1)


_voronoi = declare(
    "voronoi", STATUS, seeds=i8("count", 2), queue=i4("places", 2, out=True), labels=i4("height", "width", out=True)
)


def voronoi(seeds, height, width):
    """Return the index ``[h,w]`` int32 of the seed that is the fewest steps away from each pixel.

    Steps go to 4-neighbours, so every region is connected. ``seeds [count,2]`` int64 are y and x of pixels. Raises
    ValueError for a seed outside of the picture.
    """
    labels = np.empty((height, width), np.int32)
    _voronoi(seeds, np.empty((height * width + len(seeds), 2), np.int32), labels)
    return labels
