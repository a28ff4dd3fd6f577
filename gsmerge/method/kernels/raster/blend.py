"""Blend a view front to back, tile by tile, sum over its blending weights, and run the backward pass.

All kernels here use the same lists and the same weights, see ``gsmerge/method/kernels/raster/walk.h``. An intersection
is a Gaussian in the list of a tile. The backward pass writes sums over the pixels of a tile to a row for each
intersection. The backward pass then adds the rows of each Gaussian in the order of the lists. Threads share no numbers,
so results do not depend on the number of threads. The formula is in ``gsmerge/method/kernels/raster/blend_backward.c``.
"""

from __future__ import annotations

from gsmerge.method.kernels.raster.binning import MOST_TILES
from gsmerge.method.kernels.raster.project import CONIC, MAX_SIZE, SUMS
from gsmerge.method.kernels.signature import STATUS, f4, i4, i8, native, u1

CHANNELS = 4  # number of channels that weighted_sums adds up at a time
MAX_ALPHA = 0.99  # largest alpha of a Gaussian at a pixel, as in gsplat

# Arguments of every kernel that reads the lists of tiles, see gsmerge.method.kernels.raster. C code checks their
# indices
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

    ``image`` and ``transmittance`` have the rows of the view from ``top`` on. Tiles that begin outside of the rows of
    ``image`` are left out.
    """


@native(STATUS, **LISTS, **TILES, limit=f4(), covered=u1("h", "w", out=True))
def cover(conics, flatten_ids, isect_offsets, tile_width, first, last, limit, covered):
    """Write 1 to ``covered [h,w]`` at pixels of a range of tiles with at most the transmittance ``limit``, 0 at others.

    A tile ends where all of its pixels are covered, so this takes less time than :func:`blend`.
    """


@native(STATUS, **LISTS, **TILES, image=f4("h", "w", "channels"), slots=f4("n", CHANNELS, out=True))
def weighted_sums(conics, flatten_ids, isect_offsets, tile_width, first, last, image, slots):
    """Write sums of blending weights times the channels of an image, for each intersection of a range of tiles.

    The sums are over the pixels of a tile, and are written to ``slots [intersections,CHANNELS]``. ``image [h,w,c]`` has
    at most ``CHANNELS`` channels.
    """


@native(
    STATUS, flatten_ids=i4("n"), slots=f4("n", CHANNELS), ids=i4("m"),
    first=i8(least=0, below="channels"), sums=f4("gaussians", "channels", out=True),
)  # fmt: skip
def add_slots(flatten_ids, slots, ids, first, sums):
    """Add the ``slots [intersections,CHANNELS]`` of each Gaussian, in the order of the lists, to ``sums [n,c]``.

    The channels of the slots are added to the channels of the sums from ``first`` on.
    """


@native(STATUS, **LISTS, colors=f4("m", 3), image=f4("h", "w", 3, out=True), totals=f4("m", 2, out=True))
def survey(conics, flatten_ids, isect_offsets, tile_width, colors, image, totals):
    """Blend all tiles over black, and sum the weights in the same pass, as :func:`contributions` does."""


@native(STATUS, **LISTS, height=i8(least=1), width=i8(least=1), totals=f4("m", 2, out=True))
def contributions(conics, flatten_ids, isect_offsets, tile_width, height, width, totals):
    """Add each Gaussian's sum of weights to ``totals[:, 0]``, and raise ``totals[:, 1]`` to its largest weight.

    ``totals`` are ``[m,2]`` float32.
    """


@native(
    STATUS, conics=LISTS["conics"], flatten_ids=LISTS["flatten_ids"], left=i8(), top=i8(), parts=i4("n", 3, out=True),
)  # fmt: skip
def parts_of_tile(conics, flatten_ids, left, top, parts):
    """Write the part of a tile in which each Gaussian of a list shows.

    Other kernels blend a Gaussian only in this part of the tile.

    The tile begins at the pixel (``left``, ``top``). A part is a first row, a last row, and the first of eight columns
    that contain all of the Gaussian, or -1 if eight are too few.
    """


@native(
    STATUS, **LISTS, colors=f4("m", 3), **TILES, image=f4("h", "w", 3), transmittance=f4("h", "w"),
    grad_image=f4("h", "w", 3), grad_left=f4("h", "w", optional=True), slots=f4("n", SUMS, out=True),
)  # fmt: skip
def blend_backward(
    conics, flatten_ids, isect_offsets, tile_width, colors, first, last,
    image, transmittance, grad_image, grad_left, slots,
):  # fmt: skip
    """Run the backward pass of :func:`blend` for a range of tiles.

    A row of ``SUMS`` numbers is written for each intersection. From the sum of a Gaussian's rows,
    :func:`gsmerge.method.kernels.raster.project.project_backward` computes its gradients.

    Args:
        image: ``[h,w,3]`` float32 blended image with its background.
        transmittance: ``[h,w]`` float32 transmittance of all Gaussians together.
        grad_image: ``[h,w,3]`` float32 gradient of the loss with respect to ``image``.
        grad_left: ``[h,w]`` float32 gradient of the loss with respect to ``transmittance``, or None for zero.
        slots: ``[intersections,SUMS]`` float32, written at the intersections of these tiles.
    """


@native(
    STATUS, flatten_ids=i4("n"), slots=f4("n", SUMS), first=i8(), last=i8(),
    sums=f4("m", SUMS, out=True),
)  # fmt: skip
def gather_slots(flatten_ids, slots, first, last, sums):
    """Add the ``slots [intersections,SUMS]`` of a range of Gaussians to ``sums [m,SUMS]`` in the order of the lists."""
