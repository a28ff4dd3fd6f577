"""Find the superpixel of a view to which each Gaussian contributes most.

The paper's supplement has this rule for backbones whose Gaussians do not belong to pixels.

A pair is a Gaussian and a superpixel that it touches, with the sum of its blending weights there. Tiles are read row by
row. The pairs of a Gaussian form a linked list. After each row, the pairs of Gaussians that do not reach into the next
row are evaluated, and all others are kept. Because only one row of tiles is kept, memory grows with the width of the
view, not with its height.
"""

from __future__ import annotations

import numpy as np

from gsmerge.method.kernels.raster.binning import MOST_TILES
from gsmerge.method.kernels.raster.blend import LISTS
from gsmerge.method.kernels.raster.project import CONIC, TILE
from gsmerge.method.kernels.signature import STATUS, f4, f8, i4, i8, native

FIRST_PAIRS = 1 << 16  # room for this many pairs at the start
PAIR = 3  # columns of a pair: label, sum, and the next pair of the Gaussian or -1
# Positions in `counts` of the number of pairs, the number of Gaussians with pairs, and the next tile. Then its length
NUM_PAIRS = 0
NUM_ACTIVE = 1
NEXT_TILE = 2
PAIR_COUNTS = 3


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
    """Evaluate the pairs of the Gaussians that end above the row ``bottom``, and copy all other pairs to ``carried``.

    The largest sum of a Gaussian over the pairs of one superpixel is written, and the label of this superpixel.
    """


def dominant_labels(conics, flatten_ids, isect_offsets, tile_width, labels, count):
    """Return each Gaussian's largest sum of blending weights in a superpixel, and the superpixel's label.

    The sums are ``[m]`` float32, and the labels ``[m]`` int32. The smallest label is returned if sums are equal. If no
    pixel shows a Gaussian, the sum is 0 and the label is -1.

    Args:
        labels: ``[h,w]`` int32, below ``count``.
    """
    # lines of tiles
    num = len(conics)
    last_line = -(-labels.shape[0] // TILE) - 1
    values = np.zeros(num, np.float32)
    owners = np.full(num, -1, np.int32)
    # Scratch for superpixels, then the first pair of each Gaussian, the Gaussians with pairs, and `counts`
    stamps = np.full(count, -1, np.int32)
    totals = np.zeros(count)
    seen = np.empty(count, np.int32)
    heads = np.full(num, -1, np.int32)
    active = np.empty(num + 1, np.int32)
    counts = np.zeros(PAIR_COUNTS, np.int64)
    pairs = np.empty((FIRST_PAIRS, PAIR))
    for line in range(last_line + 1):
        while counts[NEXT_TILE] < (line + 1) * tile_width:
            add_row(conics, flatten_ids, isect_offsets, tile_width, line, labels, heads, pairs, active, stamps, counts)
            if counts[NEXT_TILE] < (line + 1) * tile_width:  # the pairs of some tiles did not fit
                pairs = np.concatenate([pairs, np.empty_like(pairs)])
        bottom = (line + 1) * TILE if line < last_line else np.iinfo(np.int32).max
        carried = np.empty_like(pairs)
        settle_row(bottom, conics, heads, pairs, carried, active, totals, seen, values, owners, counts)
        pairs = carried
    return values, owners
