"""Seeds for superpixels, and the regions that grow from them."""

from __future__ import annotations

import math

import numpy as np

from gsmerge.kernels.jit import kernel

DENSITY_FLOOR = 0.3  # share of the seeds that is spread evenly
JITTER = 0.3  # width of the noise on the dithering threshold, against worm patterns


def hexagonal_seeds(height, width, count):
    """``[count,2]`` int64 (y, x): distinct pixels near a hexagonal grid, whose rows share the seeds evenly."""
    row_distance = math.sqrt(height * width / count * math.sqrt(3) / 2)
    num_rows = min(max(round(height / row_distance), math.ceil(count / width)), height, count)
    first = np.arange(num_rows + 1) * count // num_rows
    row = np.repeat(np.arange(num_rows), np.diff(first))
    place, row_length = np.arange(count) - first[row], np.diff(first)[row]
    y = (2 * row + 1) * height // (2 * num_rows)
    x = (place + np.where(row % 2 == 0, 0.25, 0.75)) * width / row_length
    return np.stack([y, x.astype(np.int64)], 1)


def seed_density(saliency, count):
    """``[h,w]`` float64 seeds per pixel, at most 1 and ``count`` in all; even where nothing is salient."""
    density = np.sqrt(saliency, dtype=np.float64)
    density = DENSITY_FLOOR + (1 - DENSITY_FLOOR) * density / max(density.mean(), 1e-12)
    density *= count / density.sum()
    while (density > 1).any():
        full = density >= 1
        density[full] = 1
        rest = count - np.count_nonzero(full)
        density[~full] *= rest / density[~full].sum() if rest > 0 else 0
    return density


@kernel(exact=True)
def dither(density):
    """Serpentine Floyd-Steinberg dithering with a jittered threshold: ``[h,w]`` bool, True at a seed."""
    height, width = density.shape
    seeds = np.zeros((height, width), np.bool_)
    errors = np.zeros((2, width + 2))
    noise = np.uint32(1)
    for y in range(height):
        here, below = errors[y % 2], errors[(y + 1) % 2]
        below[:] = 0
        ahead = 1 if y % 2 == 0 else -1
        for step in range(width):
            x = step if ahead == 1 else width - 1 - step
            noise = np.uint32(noise * np.uint32(1664525) + np.uint32(1013904223))
            threshold = 0.5 + JITTER * ((noise >> np.uint32(8)) / 16777216.0 - 0.5)
            share = density[y, x] + here[x + 1]
            seeds[y, x] = share > threshold
            error = share - (1.0 if seeds[y, x] else 0.0)
            here[x + 1 + ahead] += error * 0.4375
            below[x + 1 - ahead] += error * 0.1875
            below[x + 1] += error * 0.3125
            below[x + 1 + ahead] += error * 0.0625
    return seeds


def _spread_picks(weights, count):
    """``count`` distinct indices, spread evenly over the running sum of the weights."""
    total = np.cumsum(weights)
    order = np.arange(count)
    picks = np.searchsorted(total, (order + 0.5) * (total[-1] / count))
    picks = np.maximum.accumulate(picks - order) + order
    return np.minimum(picks, len(weights) - count + order)


def seeds_from_density(density, count):
    """``[count,2]`` int64 (y, x): distinct pixels that follow the density.

    Dithering loses a few seeds at the picture's edge; they are added or taken away evenly, to the exact number.
    """
    seeds = dither(density).reshape(-1)
    surplus = np.count_nonzero(seeds) - count
    if surplus != 0:
        candidates = np.flatnonzero(seeds == (surplus > 0))
        weights = np.ones(len(candidates)) if surplus > 0 else density.reshape(-1)[candidates] + 1e-9
        seeds[candidates[_spread_picks(weights, abs(surplus))]] = surplus < 0
    return np.stack(np.unravel_index(np.flatnonzero(seeds), density.shape), 1)


@kernel
def voronoi(seeds, height, width):
    """``[h,w]`` int32: the seed nearest to each pixel, counted in steps to 4-neighbours; every region is connected."""
    labels = np.full((height, width), -1, np.int32)
    queue = np.empty((height * width, 2), np.int64)
    tail = len(seeds)
    for label in range(tail):
        y, x = seeds[label, 0], seeds[label, 1]
        labels[y, x] = label
        queue[label, 0], queue[label, 1] = y, x
    head = 0
    while head < tail:
        y, x = queue[head, 0], queue[head, 1]
        head += 1
        for next_y, next_x in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
            if 0 <= next_y < height and 0 <= next_x < width and labels[next_y, next_x] < 0:
                labels[next_y, next_x] = labels[y, x]
                queue[tail, 0], queue[tail, 1] = next_y, next_x
                tail += 1
    return labels
