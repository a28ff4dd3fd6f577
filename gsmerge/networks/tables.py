"""Groups of any size as padded tables: sorted by size, and a stratified sample of groups that are too large."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

TOKENS = 4096  # tokens of one table: a megabyte of activations, which stay in a processor's cache


def split_tables(sizes: np.ndarray, max_width: int) -> Iterator[tuple[np.ndarray, int]]:
    """Tables of groups of similar size: rows of ``sizes`` and the table's width, a power of two.

    Which groups share a table depends only on the sizes.

    Args:
        sizes: ``[g]`` members of each group, at least 1.
        max_width: Width of the widest table; larger groups are sampled.
    """
    widths = np.minimum(1 << np.ceil(np.log2(np.maximum(sizes, 1))).astype(np.int64), max_width)
    for width in np.unique(widths):
        rows = np.flatnonzero(widths == width)
        step = max(1, TOKENS // int(width))
        for first in range(0, len(rows), step):
            yield rows[first : first + step], int(width)


def group_rows(begins: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions of all members of groups that begin at ``begins [g]``, group by group, and the group of each."""
    owners = np.repeat(np.arange(len(sizes)), sizes)
    first = np.cumsum(sizes) - sizes
    return np.arange(len(owners)) - first[owners] + begins[owners], owners


def sample_members(keys: np.ndarray, sizes: np.ndarray, width: int, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most ``width`` members of every group, sorted by a key, whatever their order in the input.

    A group that is too large is cut along its key into ``width`` runs as equal as possible, and one member of each is
    taken at random: the sample covers the group (paper supplement, encoder compute).

    Args:
        keys: ``[m]`` key of each member, group by group.
        sizes: ``[g]`` members of each group.
        width: Columns of the table.
        seeds: ``[g]`` uint64 seed of each group's random numbers.

    Returns:
        ``[g,width]`` positions into ``keys``, and a mask of the valid ones; the others repeat the group's first.
    """
    first = np.cumsum(sizes) - sizes
    order = np.lexsort((keys, np.repeat(np.arange(len(sizes)), sizes)))
    slots = np.arange(width)[None]
    large = (sizes > width)[:, None]
    low = slots * sizes[:, None] // width
    high = (slots + 1) * sizes[:, None] // width
    draws = low + np.floor(hash_uniform(seeds[:, None], slots.astype(np.uint64)) * (high - low)).astype(np.int64)
    within = np.where(large, draws, np.minimum(slots, sizes[:, None] - 1))
    mask = large | (slots < sizes[:, None])
    return order[first[:, None] + np.where(mask, within, 0)], mask


def hash_uniform(seeds: np.ndarray, salts: np.ndarray) -> np.ndarray:
    """Numbers in [0, 1) that depend only on seeds and salts (splitmix64, Steele et al. 2014)."""
    return (hash_pairs(seeds, salts) >> np.uint64(11)).astype(np.float64) * 2.0**-53


def hash_pairs(seeds: np.ndarray, salts: np.ndarray) -> np.ndarray:
    """uint64 hashes of pairs of uint64."""
    x = seeds + (salts + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


def point_seeds(points: np.ndarray, seed: int) -> np.ndarray:
    """``[n]`` uint64 that depend on float32 positions ``[n,3]`` and a seed, not on the order of the points."""
    bits = np.ascontiguousarray(points, np.float32).view(np.uint32).astype(np.uint64)
    hashes = np.full(len(points), seed & (2**64 - 1), np.uint64)
    for column in bits.T:
        hashes = hash_pairs(hashes, column)
    return hashes
