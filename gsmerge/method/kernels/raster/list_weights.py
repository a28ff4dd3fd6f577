"""List the blending weights of a view, each with its pixel, and multiply images by them."""

from __future__ import annotations

import numpy as np

from gsmerge.method.kernels.raster import blend
from gsmerge.method.kernels.signature import STATUS, declare, f4, f8, i4, i8, native, u1

LANES = 4  # number of channels of an image that are multiplied at a time
BATCH_ENTRIES = 32 * 256  # most entries of a batch of 32 Gaussians in a tile of 256 pixels

ENTRIES = {
    "starts": i8("more", least=0, most="entries", ascending=True),
    "lanes": u1("entries"),
    "weights": f4("entries"),
    "flatten_ids": i4("n", least=0, below="m"),
    "isect_offsets": i8("ends", least=0, most="n", ascending=True),
    "tile_width": i8(least=1),
}


# Appends the entries of further tiles, as far as they fit. progress has the next tile, and the number of entries so far
_list_weights = declare(
    "list_weights", STATUS, **blend.LISTS, height=i8(least=1), width=i8(least=1), starts=i8("more", out=True),
    lanes=u1("room", out=True), weights=f4("room", out=True), progress=i8(2, least=0, out=True),
)  # fmt: skip


def list_weights(conics, flatten_ids, isect_offsets, tile_width, height, width):
    """List all blending weights of a view that are not zero.

    Returns:
        The start ``[intersections + 1]`` int64 of each intersection in a list of entries, and two arrays with the
        pixels and the weights of the entries. Pixels are uint8, and are numbered row by row within the tile. Weights
        are float32.
    """
    starts = np.zeros(len(flatten_ids) + 1, np.int64)
    progress = np.zeros(2, np.int64)
    first_entries = 40  # room for this many entries for each pixel at the start
    lanes, weights = (
        np.empty(max(BATCH_ENTRIES, first_entries * height * width), dtype) for dtype in (np.uint8, np.float32)
    )
    while True:
        _list_weights(conics, flatten_ids, isect_offsets, tile_width, height, width, starts, lanes, weights, progress)
        next_tile, count = progress
        if next_tile == len(isect_offsets) - 1:
            return starts, lanes[:count].copy(), weights[:count].copy()
        lanes, weights = (np.concatenate([array, np.empty_like(array)]) for array in (lanes, weights))


@native(STATUS, **ENTRIES, image=f4("h", "w", LANES), sums=f8("m", LANES, out=True))
def collect(starts, lanes, weights, flatten_ids, isect_offsets, tile_width, image, sums):
    """Add each Gaussian's weights times the pixels of ``image [h,w,LANES]`` to ``sums [m,LANES]`` float64."""
