"""Exact border moves between regions: each lowers the squared error, and none takes a region apart."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.jit import kernel
from gsmerge.kernels.superpixels.regions import NUM_PIXELS, region_rows

LEAVE, JOIN = 6, 7  # columns of a region's row: n / (n - 1) for a pixel that leaves, n / (n + 1) for one that joins


def connectivity_table() -> np.ndarray:
    """``[256]`` uint8: 1 where a pixel may leave its region without taking it apart.

    Bit i of the index is set if neighbour i (N, NE, E, SE, S, SW, W, NW) has the pixel's label. The label's cells of
    the ring must form one 4-connected part that touches the pixel by an edge; counted as edge cells less the
    corners that join two of them (Yokoi's connectivity number); a closed ring has as many of both.
    """
    cells = (np.arange(256)[:, None] >> np.arange(8)) & 1
    edges, corners = cells[:, 0::2], cells[:, 1::2]
    joined = edges * corners * np.roll(edges, -1, axis=1)
    return ((edges.sum(1) - joined.sum(1) == 1) | cells.all(1)).astype(np.uint8)


@kernel(inline=True)
def ring_mask(labels, y, x, label):
    """Bits of the eight neighbours (N, NE, E, SE, S, SW, W, NW) that have ``label``."""
    return (
        (labels[y - 1, x] == label)
        | (labels[y - 1, x + 1] == label) << 1
        | (labels[y, x + 1] == label) << 2
        | (labels[y + 1, x + 1] == label) << 3
        | (labels[y + 1, x] == label) << 4
        | (labels[y + 1, x - 1] == label) << 5
        | (labels[y, x - 1] == label) << 6
        | (labels[y - 1, x - 1] == label) << 7
    )


@kernel(part=True)
def distance(rows, label, f0, f1, f2, f3, f4):
    """Squared distance of a pixel's feature to a region's mean."""
    d0, d1, d2 = f0 - rows[label, 0], f1 - rows[label, 1], f2 - rows[label, 2]
    d3, d4 = f3 - rows[label, 3], f4 - rows[label, 4]
    return d0 * d0 + d1 * d1 + d2 * d2 + d3 * d3 + d4 * d4


@kernel
def _shift(rows, label, sign, f0, f1, f2, f3, f4):
    """Add (sign 1) or take away (sign -1) one pixel."""
    one = np.float32(1)
    num_pixels = rows[label, NUM_PIXELS] + sign
    step = sign / num_pixels
    rows[label, NUM_PIXELS] = num_pixels
    rows[label, LEAVE], rows[label, JOIN] = num_pixels / (num_pixels - one), num_pixels / (num_pixels + one)
    rows[label, 0] += step * (f0 - rows[label, 0])
    rows[label, 1] += step * (f1 - rows[label, 1])
    rows[label, 2] += step * (f2 - rows[label, 2])
    rows[label, 3] += step * (f3 - rows[label, 3])
    rows[label, 4] += step * (f4 - rows[label, 4])


@kernel
def sweep(labels, pixels, rows, table, spread, backward):
    """One raster pass of border moves: each lowers the total squared error, and the means follow at once.

    A pixel goes from region A to a 4-neighbour's region B if ``n_A/(n_A-1)·d_A² > n_B/(n_B+1)·d_B²`` and A stays
    connected without it. It needs a neighbour of its own label, so that no region can run empty.
    """
    height, width, _ = pixels.shape
    one = np.float32(1)
    num_moved = 0
    for step_y in range(1, height + 1):
        y = height + 1 - step_y if backward else step_y
        f3 = spread * np.float32(y - 1)
        for step_x in range(1, width + 1):
            x = width + 1 - step_x if backward else step_x
            own = labels[y, x]
            north, east, south, west = labels[y - 1, x], labels[y, x + 1], labels[y + 1, x], labels[y, x - 1]
            if (north == own) & (east == own) & (south == own) & (west == own):
                continue
            if table[ring_mask(labels, y, x, own)] == 0:
                continue
            f0, f1, f2 = pixels[y - 1, x - 1, 0], pixels[y - 1, x - 1, 1], pixels[y - 1, x - 1, 2]
            f4 = spread * np.float32(x - 1)
            best, best_label = distance(rows, own, f0, f1, f2, f3, f4) * rows[own, LEAVE], own
            for label in (north, east, south, west):
                if label < 0 or label == own or label == best_label:  # noqa: SIM109 - faster
                    continue
                cost = distance(rows, label, f0, f1, f2, f3, f4) * rows[label, JOIN]
                if cost < best:
                    best, best_label = cost, label
            if best_label != own:
                labels[y, x] = best_label
                _shift(rows, own, -one, f0, f1, f2, f3, f4)
                _shift(rows, best_label, one, f0, f1, f2, f3, f4)
                num_moved += 1
    return num_moved


CONNECTIVITY = connectivity_table()


def refine(labels, pixels, count, num_sweeps, spread):
    """Sweep in place, forth and back, until nothing moves or ``num_sweeps`` are done; returns the padded labels.

    Each of the ``count`` regions is 4-connected and not empty, and stays so. ``spread``: square root of the weight of
    squared pixels against squared colours, float32.
    """
    rows = region_rows(labels, pixels, count, count, spread)
    num_pixels = rows[:, NUM_PIXELS]
    rows[:, LEAVE] = num_pixels / np.maximum(num_pixels - 1, 1)  # the pixel of a one-pixel region never leaves
    rows[:, JOIN] = num_pixels / (num_pixels + 1)
    for i in range(num_sweeps):
        if sweep(labels, pixels, rows, CONNECTIVITY, spread, i % 2 == 1) == 0:
            break
    return labels
