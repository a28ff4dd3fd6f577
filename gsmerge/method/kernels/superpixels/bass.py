"""Cut pictures into superpixels by BASS (Uziel, Ronen and Freifeld 2019), without its splits and merges.

The regions grow from seeds, which are on a grid, or are chosen by how much each pixel resembles a corner.

Each region is a Gaussian in colour and in position. The colour has a fixed standard deviation, and the position has a
normal-inverse-Wishart prior. Each round fits the Gaussians of the regions, and then moves pixels to the most likely
regions (hard expectation maximisation). A Potts term keeps borders short. A pixel may change its label only if every
region stays connected, so no region becomes empty. Pixels at the border of the picture may change as well.
"""

from __future__ import annotations

import math

import numpy as np

from gsmerge.method.kernels.signature import COUNT, STATUS, declare, f4, f8, i4, i8, native, u1

COLOUR_DEVIATION = 0.018 / 2  # standard deviation of colours, in CIELAB divided by 100
REGION_COLUMNS = 9  # number of a region's parameters
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
    column = np.arange(count) - row_starts[row]
    row_length = np.diff(row_starts)[row]
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
        # different candidates, at equal steps of the cumulative sum of their weights
        total = np.cumsum(weights)
        order = np.arange(abs(surplus))
        picks = np.searchsorted(total, (order + 0.5) * (total[-1] / len(order)))
        picks = np.maximum.accumulate(picks - order) + order
        picks = np.minimum(picks, len(weights) - len(order) + order)
        seeds[candidates[picks]] = surplus < 0
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


def simple_point_table():
    """Return a table ``[256]`` uint8 that is 1 for rings of eight neighbours with which a pixel may change its label.

    Bit i of the index is set if neighbour i (N, NE, E, SE, S, SW, W, NW) has the label of the pixel. The pixel may
    change if the ring consists of one arc of neighbours with this label and one arc of other neighbours. In each arc, a
    neighbour has to share a side with the pixel.
    """
    cells = (np.arange(256)[:, None] >> np.arange(8)) & 1
    changes = (cells != np.roll(cells, 1, axis=1)).sum(1)
    edges = cells[:, 0::2].sum(1)
    return ((changes == 2) & (edges > 0) & (edges < 4)).astype(np.uint8)


# `sums` are zero before
_fit_regions = declare(
    "fit_regions", STATUS, labels=i4("padded_height", "padded_width"), colours=f4("height", "width", 3),
    areas=f8("count"), sums=f8("count", 9, out=True), rows=f4("count", REGION_COLUMNS, out=True),
)  # fmt: skip


def fit_regions(labels, colours, areas):
    """Return the parameters ``[count,9]`` float32 of every region: means, inverse covariance, and its log-determinant.

    The covariance is ``(A² I + S) / (n + 50 A - 3)``. S is the scatter of the n positions of a region. A is the
    expected area of a region in pixels, from ``areas [count]`` float64.
    """
    rows = np.empty((len(areas), REGION_COLUMNS), np.float32)
    _fit_regions(labels, colours, areas, np.zeros((len(areas), 9)), rows)
    return rows


@native(
    COUNT, labels=i4("padded_height", "padded_width", out=True), colours=f4("height", "width", 3),
    rows=f4("count", REGION_COLUMNS), table=u1(256), foreign=f4(256), precision=f4(),
)  # fmt: skip
def label_pass(labels, colours, rows, table, foreign, precision):
    """Visit all pixels at borders between regions once, and return how many changed their label.

    The pixels are visited in four grids. No two pixels of a grid are neighbours, so their order has no effect.
    """


def infer_labels(labels, colours, count):
    """Improve padded labels in place, and return them.

    There are as many rounds as the side of a superpixel has pixels. Each round fits the regions, and moves pixels to
    their most likely regions. Each of the ``count`` regions is 4-connected and not empty, and remains 4-connected and
    not empty. ``colours [h,w,3]`` are CIELAB values divided by 100.
    """
    height, width, _ = colours.shape
    areas = np.full(count, height * width / count)  # expected areas of the regions in pixels
    table = simple_point_table()
    # Number of neighbours with other labels, for each ring of `simple_point_table`
    foreign = 8 - ((np.arange(256)[:, None] >> np.arange(8)) & 1).sum(1).astype(np.float32)
    precision = np.float32(1 / COLOUR_DEVIATION**2)
    num_passes = 4  # most passes over the labels after each fit of the parameters
    for _ in range(max(1, round((height * width / count) ** 0.5))):
        rows = fit_regions(labels, colours, areas)
        for _ in range(num_passes):
            if label_pass(labels, colours, rows, table, foreign, precision) == 0:
                break
    return labels
