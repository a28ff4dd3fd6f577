"""Blend one view front to back, tile by tile, sum over its blending weights, and run the backward pass.

All kernels here use the same lists with the same weights, see ``gsmerge/kernels/raster/walk.h``. The backward pass
writes the sums over a tile to one row per intersection, and then adds the rows up in the order of the lists. Threads
share nothing, and results do not depend on their number. The formula is in ``gsmerge/kernels/raster/blend_backward.c``.
"""

from __future__ import annotations

from gsmerge.kernels.raster.binning import MOST_TILES
from gsmerge.kernels.raster.project import CONIC, MAX_SIZE, SUMS
from gsmerge.kernels.signature import STATUS, f4, i4, i8, native

CHANNELS = 4  # channels that weighted_sums adds up at a time
MAX_ALPHA = 0.99  # largest alpha of a Gaussian at a pixel (gsplat)

# Arguments of every kernel that reads tile lists, see the package; the library checks indices as it reads them.
LISTS = {
    "conics": f4("m", CONIC),
    "flatten_ids": i4("n"),
    "isect_offsets": i8("ends"),
    "tile_width": i8(least=0, most=MOST_TILES),
}
TILES = {"first": i8(), "last": i8()}


@native(
    STATUS, **LISTS, colors=f4("m", 3), **TILES, top=i8(least=0, below=MAX_SIZE), background=f4(3),
    image=f4("h", "w", 3, out=True), transmittance=f4("h", "w", out=True),
)  # fmt: skip
def blend(conics, flatten_ids, isect_offsets, tile_width, colors, first, last, top, background, image, transmittance):
    """Blend a range of tiles over ``background [3]`` into ``image [h,w,3]`` and ``transmittance [h,w]``.

    These arrays have the view's rows from ``top`` on. Tiles that begin outside of them are skipped.
    """


@native(STATUS, **LISTS, **TILES, image=f4("h", "w", "channels"), slots=f4("n", CHANNELS, out=True))
def weighted_sums(conics, flatten_ids, isect_offsets, tile_width, first, last, image, slots):
    """Sum the weights times up to four channels of an image, for each intersection of a range of tiles.

    ``image [h,w,c]``, c <= CHANNELS; ``slots [intersections,CHANNELS]`` is written at the intersections of these tiles.
    """


@native(
    STATUS, flatten_ids=i4("n"), slots=f4("n", CHANNELS), ids=i4("m"),
    first=i8(least=0, below="channels"), sums=f4("gaussians", "channels", out=True),
)  # fmt: skip
def add_slots(flatten_ids, slots, ids, first, sums):
    """Add the intersections' ``slots [intersections,CHANNELS]`` to ``sums [n,c]`` from channel ``first`` on.

    They are added in the order of the lists.
    """


@native(STATUS, **LISTS, colors=f4("m", 3), image=f4("h", "w", 3, out=True), totals=f4("m", 2, out=True))
def survey(conics, flatten_ids, isect_offsets, tile_width, colors, image, totals):
    """Blend all tiles over black, and sum the weights as :func:`contributions` does, in one pass."""


@native(STATUS, **LISTS, height=i8(least=1), width=i8(least=1), totals=f4("m", 2, out=True))
def contributions(conics, flatten_ids, isect_offsets, tile_width, height, width, totals):
    """Add each Gaussian's sum of weights to ``totals[:, 0]``, and raise ``totals[:, 1]`` to its largest weight.

    ``totals [m,2]`` float32.
    """


@native(
    STATUS, conics=LISTS["conics"], flatten_ids=LISTS["flatten_ids"], left=i8(), top=i8(), parts=i4("n", 3, out=True),
)  # fmt: skip
def parts_of_tile(conics, flatten_ids, left, top, parts):
    """Write the part of the tile at a pixel in which each Gaussian shows, as all kernels use it.

    ``parts`` are first and last row, and the first of eight columns that cover the Gaussian, -1 if eight are too few.
    """


@native(
    STATUS, **LISTS, colors=f4("m", 3), **TILES, image=f4("h", "w", 3), transmittance=f4("h", "w"),
    grad_image=f4("h", "w", 3), grad_left=f4("h", "w", optional=True), slots=f4("n", SUMS, out=True),
)  # fmt: skip
def blend_backward(
    conics, flatten_ids, isect_offsets, tile_width, colors, first, last,
    image, transmittance, grad_image, grad_left, slots,
):  # fmt: skip
    """Write the gradient sums of a range of tiles, one row per intersection.

    Args:
        image: ``[h,w,3]`` float32, the blended image with its background.
        transmittance: ``[h,w]`` float32 remaining transmittance.
        grad_image: ``[h,w,3]`` float32, gradient with respect to ``image``.
        grad_left: ``[h,w]`` float32, gradient with respect to ``transmittance``; None for zero.
        slots: ``[intersections,SUMS]`` float32, written at the intersections of these tiles.
    """


@native(
    STATUS, flatten_ids=i4("n"), slots=f4("n", SUMS), first=i8(), last=i8(),
    sums=f4("m", SUMS, out=True),
)  # fmt: skip
def gather_slots(flatten_ids, slots, first, last, sums):
    """Add the ``slots [intersections,SUMS]`` of some Gaussians to ``sums [m,SUMS]``, in the order of the lists."""
