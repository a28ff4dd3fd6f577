"""Front-to-back blending of one view, tile by tile, and sums over its blending weights.

All kernels here walk the same lists with the same weights, see ``gsmerge/kernels/raster/walk.h``.
"""

from __future__ import annotations

from gsmerge.kernels.raster.project import FOOTPRINT
from gsmerge.kernels.signature import STATUS, f4, i4, i8, native

CHANNELS = 4  # channels that one walk of weighted_sums adds up
MAX_ALPHA = 0.99  # largest share of the light that one Gaussian takes (gsplat)

# Arguments of every walk, see the package; the library checks indices on its way.
LISTS = {
    "footprints": f4("m", FOOTPRINT),
    "members": i4("n"),
    "offsets": i8("ends"),
    "columns": i8(),
}
TILES = {"first": i8(), "last": i8()}


@native(
    STATUS, footprints=LISTS["footprints"], colors=f4("m", 3), members=LISTS["members"], offsets=LISTS["offsets"],
    columns=LISTS["columns"], **TILES, background=f4(3), image=f4("h", "w", 3, out=True),
    transmittance=f4("h", "w", out=True),
)  # fmt: skip
def blend(footprints, colors, members, offsets, columns, first, last, background, image, transmittance):
    """Blend a range of tiles over ``background [3]`` into ``image [h,w,3]`` and ``transmittance [h,w]``."""


@native(STATUS, **LISTS, **TILES, image=f4("h", "w", "channels"), slots=f4("n", CHANNELS, out=True))
def weighted_sums(footprints, members, offsets, columns, first, last, image, slots):
    """Per intersection of a range of tiles: the weights times up to four channels of an image, summed.

    ``image [h,w,c]``, c <= CHANNELS; ``slots [intersections,CHANNELS]`` is written in the tiles' part.
    """


@native(
    STATUS, members=i4("n"), slots=f4("n", CHANNELS), ids=i4("m"),
    first=i8(least=0, below="channels"), sums=f4("gaussians", "channels", out=True),
)  # fmt: skip
def add_slots(members, slots, ids, first, sums):
    """Add the intersections' ``slots [intersections,CHANNELS]`` to ``sums [n,c]`` from channel ``first`` on.

    They are added in the order of the lists.
    """


@native(
    STATUS, footprints=LISTS["footprints"], colors=f4("m", 3), members=LISTS["members"], offsets=LISTS["offsets"],
    columns=LISTS["columns"], image=f4("h", "w", 3, out=True), totals=f4("m", 2, out=True),
)  # fmt: skip
def survey(footprints, colors, members, offsets, columns, image, totals):
    """Do the work of :func:`blend`, of all tiles over black, and of :func:`contributions` in one walk."""


@native(STATUS, **LISTS, height=i8(least=1), width=i8(least=1), totals=f4("m", 2, out=True))
def contributions(footprints, members, offsets, columns, height, width, totals):
    """Add every Gaussian's weights over the pixels to ``totals[:, 0]``; raise ``totals[:, 1]`` to the largest of them.

    ``totals [m,2]`` float32.
    """


@native(
    STATUS, footprints=LISTS["footprints"], members=LISTS["members"], left=i8(), top=i8(), rows=i4("n", 2, out=True),
)  # fmt: skip
def rows_in_tile(footprints, members, left, top, rows):
    """Write first and last row ``[n,2]`` in which members show in the tile at a pixel, as all walks take them."""
