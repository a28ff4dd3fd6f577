"""Groups of any size as padded tables: bins by size, and a stratified sample of what is too large."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

TOKENS = 16384  # of one table: a few megabytes of activations, which stay in a processor's cache


def tables(sizes: np.ndarray, most: int) -> Iterator[tuple[np.ndarray, int]]:
    """Groups of similar size together: ``rows`` into ``sizes`` and the width of their table, a power of two.

    Which groups share a table depends on nothing but the sizes.

    Args:
        sizes: ``[g]`` members of each group, at least 1.
        most: Widest table; larger groups are sampled.
    """
    widths = np.minimum(1 << np.ceil(np.log2(np.maximum(sizes, 1))).astype(np.int64), most)
    for width in np.unique(widths):
        rows = np.flatnonzero(widths == width)
        step = max(1, TOKENS // int(width))
        for first in range(0, len(rows), step):
            yield rows[first : first + step], int(width)


def runs(begins: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions of all members of groups that begin at ``begins``, one group after the other, and their groups."""
    owners = np.repeat(np.arange(len(sizes)), sizes)
    first = np.cumsum(sizes) - sizes
    return np.arange(len(owners)) - first[owners] + begins[owners], owners


def choose(keys: np.ndarray, sizes: np.ndarray, width: int, dice: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most ``width`` members of every group, in order of a key: which ones the order given does not matter to.

    A group that is too large is cut along its key into ``width`` runs as equal as can be, and one member of each is
    taken at random: the sample covers the group (paper supplement, encoder compute).

    Args:
        keys: ``[m]`` number of each member, group by group.
        sizes: ``[g]`` members of each group.
        width: Columns of the table.
        dice: ``[g]`` uint64, what each group's random numbers hang on.

    Returns:
        ``[g,width]`` positions into ``keys`` and a mask of those that are there; others repeat the group's first.
    """
    first = np.cumsum(sizes) - sizes
    order = np.lexsort((keys, np.repeat(np.arange(len(sizes)), sizes)))
    slots = np.arange(width)[None]
    large = (sizes > width)[:, None]
    low = slots * sizes[:, None] // width
    high = (slots + 1) * sizes[:, None] // width
    draws = low + np.floor(uniform(dice[:, None], slots.astype(np.uint64)) * (high - low)).astype(np.int64)
    within = np.where(large, draws, np.minimum(slots, sizes[:, None] - 1))
    mask = large | (slots < sizes[:, None])
    return order[first[:, None] + np.where(mask, within, 0)], mask


def uniform(seeds: np.ndarray, salts: np.ndarray) -> np.ndarray:
    """Numbers from 0 to below 1 that hang on seeds and salts alone (splitmix64, Steele et al. 2014)."""
    return (mixed(seeds, salts) >> np.uint64(11)).astype(np.float64) * 2.0**-53


def mixed(seeds: np.ndarray, salts: np.ndarray) -> np.ndarray:
    """uint64 hashes of pairs of uint64."""
    x = seeds + (salts + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


def point_dice(points: np.ndarray, seed: int) -> np.ndarray:
    """``[n]`` uint64 that hang on float32 positions ``[n,3]`` and a seed, not on the order of the points."""
    bits = np.ascontiguousarray(points, np.float32).view(np.uint32).astype(np.uint64)
    dice = np.full(len(points), seed & (2**64 - 1), np.uint64)
    for column in bits.T:
        dice = mixed(dice, column)
    return dice
