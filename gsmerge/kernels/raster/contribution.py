"""Find the superpixel of a view to which each Gaussian contributes most.

This is the rule of the paper's supplement on non-pixel-aligned backbones.

A pair is a Gaussian and a superpixel that it touches, with the sum of its blending weights there. Pairs are summed one
row of tiles after another, and linked in a chain for each Gaussian. At the end of a row, Gaussians that do not reach
into the next row are finished, and the pairs of the others are carried over. So memory grows with the width of the
view, not with its height.
"""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.raster.binning import MOST_TILES
from gsmerge.kernels.raster.blend import LISTS
from gsmerge.kernels.raster.project import CONIC, TILE
from gsmerge.kernels.signature import STATUS, f4, f8, i4, i8, native

FIRST_PAIRS = 1 << 16  # room for this many pairs at the start
PAIR = 3  # columns of a pair: label, sum, and the next pair of the same Gaussian or -1
# Places in `counts`: number of pairs, number of Gaussians with pairs, and the next tile; and the length of `counts`
NUM_PAIRS, NUM_ACTIVE, NEXT_TILE, PAIR_COUNTS = 0, 1, 2, 3


@native(
    STATUS, **LISTS, line=i8(least=0, most=MOST_TILES), labels=i4("h", "w", least=0, below="num_labels"),
    heads=i4("m", out=True), pairs=f8("room", PAIR, out=True), active=i4("slots", out=True),
    stamps=i4("num_labels", most=-1, out=True), counts=i8(PAIR_COUNTS, out=True),
)  # fmt: skip
def add_row(conics, flatten_ids, isect_offsets, tile_width, line, labels, heads, pairs, active, stamps, counts):
    """Append the pairs of a row of tiles, from tile ``counts[NEXT_TILE]`` to the last one that fits in the buffers."""


@native(
    STATUS, bottom=i8(), conics=f4("m", CONIC), heads=i4("m", out=True), pairs=f8("room", PAIR),
    carried=f8("room", PAIR, out=True), active=i4("slots", out=True), totals=f8("num_labels", out=True),
    seen=i4("num_labels", out=True), out_values=f4("m", out=True), out_labels=i4("m", out=True),
    counts=i8(PAIR_COUNTS, out=True),
)  # fmt: skip
def settle_row(bottom, conics, heads, pairs, carried, active, totals, seen, out_values, out_labels, counts):
    """Sum the pairs of each Gaussian by superpixel; finish those that end above ``bottom``, carry over the others."""


def dominant_labels(conics, flatten_ids, isect_offsets, tile_width, labels, count):
    """Return each Gaussian's largest sum of blending weights in a superpixel, and the superpixel's label.

    Both are ``[m]``, float32 and int32.

    Of superpixels with equal sums the smallest label is returned. Gaussians that no pixel shows have 0 and -1.

    Args:
        labels: ``[h,w]`` int32, below ``count``.
    """
    num, last = len(conics), -(-labels.shape[0] // TILE) - 1
    values, owners = np.zeros(num, np.float32), np.full(num, -1, np.int32)
    stamps, totals, seen = np.full(count, -1, np.int32), np.zeros(count), np.empty(count, np.int32)
    heads, active, counts = np.full(num, -1, np.int32), np.empty(num + 1, np.int32), np.zeros(PAIR_COUNTS, np.int64)
    pairs = np.empty((FIRST_PAIRS, PAIR))
    for line in range(last + 1):
        while counts[NEXT_TILE] < (line + 1) * tile_width:
            add_row(conics, flatten_ids, isect_offsets, tile_width, line, labels, heads, pairs, active, stamps, counts)
            if counts[NEXT_TILE] < (line + 1) * tile_width:
                pairs = np.concatenate([pairs, np.empty_like(pairs)])
        bottom = (line + 1) * TILE if line < last else np.iinfo(np.int32).max
        carried = np.empty_like(pairs)
        settle_row(bottom, conics, heads, pairs, carried, active, totals, seen, values, owners, counts)
        pairs = carried
    return values, owners
