"""Sweeps over border pixels match a slow, obvious twin."""

from __future__ import annotations

import numpy as np
import pytest
from regions_of_noise import RING, SPREAD, ring_of, total_error
from skimage.measure import label as connected_parts

from gsmerge.kernels.superpixels import bass, regions
from gsmerge.kernels.superpixels.regions import pad_labels, region_rows


def test_ring_mask_reads_the_ring_in_order() -> None:
    for mask in range(256):
        assert regions.ring_mask(np.where(ring_of(mask), 5, 2).astype(np.int32), 1, 1, 5) == mask


def test_connectivity_table_matches_connected_components() -> None:
    table = regions.connectivity_table()
    for mask in range(256):
        parts = connected_parts(ring_of(mask), connectivity=1)
        touching = {int(parts[place]) for place in RING[::2]} - {0}
        assert table[mask] == (len(touching) == 1), f"{mask:08b}"


def slow_sweep(pixels: np.ndarray, labels: np.ndarray, backward: bool) -> np.ndarray:
    """Move every border pixel to where the total error is lowest, if its region stays in one piece."""
    labels, (height, width) = labels.copy(), labels.shape
    for place in sorted(np.ndindex(height, width), reverse=backward):
        y, x = place
        own = labels[place]
        rest = (labels == own) & ~((np.arange(height)[:, None] == y) & (np.arange(width) == x))
        window = rest[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2].copy()
        parts = connected_parts(window, connectivity=1)
        around = [(y - 1, x), (y, x + 1), (y + 1, x), (y, x - 1)]
        around = [(v, u) for v, u in around if 0 <= v < height and 0 <= u < width]
        touching = {int(parts[v - max(0, y - 1), u - max(0, x - 1)]) for v, u in around} - {0}
        if len(touching) != 1:
            continue
        errors = {}
        for label in dict.fromkeys([own, *(labels[p] for p in around)]):
            labels[place] = label
            errors[label] = total_error(pixels, labels)
        labels[place] = min(errors, key=errors.__getitem__)
    return labels


@pytest.mark.parametrize("backward", [False, True])
def test_sweep_makes_the_moves_that_lower_the_error(backward: bool) -> None:
    pixels = np.random.default_rng(5).random((9, 11, 3), dtype=np.float32)
    labels = bass.voronoi(bass.hexagonal_seeds(9, 11, 12), 9, 11)
    padded = pad_labels(labels)
    rows = region_rows(padded, pixels, 12, 12, SPREAD)
    rows[:, regions.LEAVE], rows[:, regions.JOIN] = rows[:, 5] / (rows[:, 5] - 1), rows[:, 5] / (rows[:, 5] + 1)
    moved = regions.sweep(padded, pixels, rows, regions.CONNECTIVITY, SPREAD, backward)
    expected = slow_sweep(pixels, labels, backward)
    assert moved >= np.count_nonzero(expected != labels) > 10
    assert np.array_equal(padded[1:-1, 1:-1], expected)
    fresh = region_rows(padded, pixels, 12, 12, SPREAD)
    assert rows[:, :6] == pytest.approx(fresh[:, :6], abs=1e-5)  # the running means stay true
