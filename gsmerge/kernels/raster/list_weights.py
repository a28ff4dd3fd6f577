"""Write the blending weights of one view as a list of (pixel, weight) entries, and multiply with them."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.raster import blend
from gsmerge.kernels.signature import STATUS, declare, f4, f8, i4, i8, native, u1

LANES = 4  # channels of an image row
BATCH_ENTRIES = 32 * 256  # most entries of a batch of Gaussians in a tile

ENTRIES = {
    "starts": i8("more", least=0, most="entries", ascending=True),
    "lanes": u1("entries"),
    "weights": f4("entries"),
    "flatten_ids": i4("n", least=0, below="m"),
    "isect_offsets": i8("ends", least=0, most="n", ascending=True),
    "tile_width": i8(least=1),
}


# Appends entries of tiles from progress[0] on after the first progress[1] entries, as far as they fit.
_list_weights = declare(
    "list_weights", STATUS, **blend.LISTS, height=i8(least=1), width=i8(least=1), starts=i8("more", out=True),
    lanes=u1("room", out=True), weights=f4("room", out=True), progress=i8(2, least=0, out=True),
)  # fmt: skip


def list_weights(conics, flatten_ids, isect_offsets, tile_width, height, width):
    """List all weights of a view that are not zero.

    Returns:
        ``starts [intersections + 1]`` int64, ``lanes`` uint8 (pixel within its tile, row-major), ``weights`` float32.
    """
    starts, progress = np.zeros(len(flatten_ids) + 1, np.int64), np.zeros(2, np.int64)
    first_entries = 40  # initial room for entries, per pixel
    lanes, weights = (
        np.empty(max(BATCH_ENTRIES, first_entries * height * width), dtype) for dtype in (np.uint8, np.float32)
    )
    while True:
        _list_weights(conics, flatten_ids, isect_offsets, tile_width, height, width, starts, lanes, weights, progress)
        tile, count = progress
        if tile == len(isect_offsets) - 1:
            return starts, lanes[:count].copy(), weights[:count].copy()
        lanes, weights = (np.concatenate([array, np.empty_like(array)]) for array in (lanes, weights))


@native(STATUS, **ENTRIES, image=f4("h", "w", LANES), sums=f8("m", LANES, out=True))
def collect(starts, lanes, weights, flatten_ids, isect_offsets, tile_width, image, sums):
    """Add weights times ``image [h,w,LANES]`` to ``sums [m,LANES]`` float64."""
