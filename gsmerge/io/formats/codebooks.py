"""Codebooks: a few values that stand for many, chosen so that the squared error is small."""

from __future__ import annotations

import heapq

import numpy as np

SIZE = 256
CELLS = 1 << 11  # as many of equal width, and of equally many values
MAX_STEPS = 200


def fit_codebook(values: np.ndarray) -> np.ndarray:
    """``[256]`` values in rising order for finite numbers of any shape, by 1-D k-means; the same for the same numbers.

    Thousands of narrow cells are merged, always the two neighbours that add the least squared error (Ward 1963), until
    256 are left, and Lloyd's steps improve those. Values far from all others so keep codes of their own. Codes that are
    left over repeat the last one.
    """
    ordered = np.sort(values, axis=None)
    distinct = np.unique(ordered)
    if len(distinct) <= SIZE:
        return np.pad(distinct, (0, SIZE - len(distinct)), "edge" if len(distinct) else "constant")
    sums = np.concatenate([[0], np.cumsum(ordered)])
    even = np.searchsorted(ordered, np.linspace(ordered[0], ordered[-1], CELLS))
    ends = np.unique([*even, *np.linspace(0, len(ordered), CELLS).astype(int)])
    codes = _merged(np.diff(ends).astype(float), np.diff(sums[ends]) / np.diff(ends))
    for _ in range(MAX_STEPS):
        ends = np.searchsorted(ordered, (codes[1:] + codes[:-1]) / 2)
        ends = np.concatenate([[0], ends, [len(ordered)]])
        number, total = np.diff(ends), np.diff(sums[ends])
        moved = np.where(number > 0, total / np.maximum(number, 1), codes)
        if np.array_equal(moved, codes):
            break
        codes = np.sort(moved)
    return codes


def _merged(numbers: np.ndarray, means: np.ndarray) -> np.ndarray:
    """Means of the cells that are left when neighbours are merged until there are 256."""
    n, m = numbers.tolist(), means.tolist()
    left, right = list(range(-1, len(n) - 1)), list(range(1, len(n) + 1))

    def cost(i: int) -> tuple[float, int, int, float, float]:
        j = right[i]
        return n[i] * n[j] / (n[i] + n[j]) * (m[i] - m[j]) ** 2, i, j, n[i], n[j]

    heap = [cost(i) for i in range(len(n) - 1)]
    heapq.heapify(heap)
    for _ in range(len(n) - SIZE):
        _, i, j, *sizes = heapq.heappop(heap)
        while right[i] != j or [n[i], n[j]] != sizes:  # one of the two has grown, or is gone
            _, i, j, *sizes = heapq.heappop(heap)
        m[i], n[i], n[j] = (n[i] * m[i] + n[j] * m[j]) / (n[i] + n[j]), n[i] + n[j], 0.0
        right[i] = right[j]
        if right[i] < len(n):
            left[right[i]] = i
            heapq.heappush(heap, cost(i))
        if left[i] >= 0:
            heapq.heappush(heap, cost(left[i]))
    return np.array([mean for mean, number in zip(m, n, strict=True) if number > 0])


def nearest_codes(codebook: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Index of the code nearest to each value, uint8, in the shape of ``values``."""
    return np.searchsorted((codebook[1:] + codebook[:-1]) / 2, values).astype(np.uint8)


def fit_palette(vectors: np.ndarray, max_bits: int) -> tuple[np.ndarray, np.ndarray]:
    """At most ``2**max_bits`` vectors that stand for ``[n,d]`` ones, and the index ``[n]`` of each one's.

    Vectors are halved at the median of the coordinate in which they differ most, group by group, and the means of the
    last groups are the palette. Where there are few enough, every vector is its own.
    """
    count = len(vectors)
    if count <= 2**max_bits:
        return vectors, np.arange(count)
    order = np.arange(count)
    starts = np.zeros(1, int)
    for _ in range(max_bits):
        sizes = np.diff([*starts, count])
        groups = np.repeat(np.arange(len(starts)), sizes)
        ordered = vectors[order]
        means = np.add.reduceat(ordered, starts) / sizes[:, None]
        axes = np.add.reduceat((ordered - means[groups]) ** 2, starts).argmax(1)
        order = order[np.lexsort((ordered[np.arange(count), axes[groups]], groups))]
        starts = np.stack([starts, starts + sizes // 2], 1).reshape(-1)
    sizes = np.diff([*starts, count])
    labels = np.empty(count, int)
    labels[order] = np.repeat(np.arange(len(starts)), sizes)
    return np.add.reduceat(vectors[order], starts) / sizes[:, None], labels
