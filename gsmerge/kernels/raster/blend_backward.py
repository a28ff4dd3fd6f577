"""The backward pass of blending: what a loss wants of every Gaussian's footprint and colour.

Sums over a tile go to one row per intersection and are then added up in the order of the lists: nothing is shared
between threads, and no result depends on them. The formula is in ``gsmerge/kernels/raster/blend_backward.c``.
"""

from __future__ import annotations

from gsmerge.kernels.raster.blend import LISTS, TILES
from gsmerge.kernels.signature import STATUS, f4, i4, i8, native

# Numbers per Gaussian: the sums of w g (3), of v = d loss / d exponent, and of v times x, y, xx, xy, yy, where x, y
# is the pixel less the Gaussian's mean.
SUMS = 9


@native(
    STATUS, footprints=LISTS["footprints"], colors=f4("m", 3), members=LISTS["members"], offsets=LISTS["offsets"],
    columns=LISTS["columns"], **TILES, image=f4("h", "w", 3), transmittance=f4("h", "w"),
    grad_image=f4("h", "w", 3), grad_left=f4("h", "w", optional=True), slots=f4("n", SUMS, out=True),
)  # fmt: skip
def blend_backward(
    footprints, colors, members, offsets, columns, first, last, image, transmittance, grad_image, grad_left, slots
):
    """Gradient sums of a range of tiles, one row per intersection.

    Args:
        image: ``[h,w,3]`` float32, the blended image, background included.
        transmittance: ``[h,w]`` float32, what is left of it.
        grad_image: ``[h,w,3]`` float32, gradient with respect to ``image``.
        grad_left: ``[h,w]`` float32, gradient with respect to ``transmittance``; None for none.
        slots: ``[intersections,SUMS]`` float32, written in the tiles' part.
    """


@native(
    STATUS, members=i4("n"), slots=f4("n", SUMS), first=i8(), last=i8(),
    sums=f4("m", SUMS, out=True),
)  # fmt: skip
def gather_slots(members, slots, first, last, sums):
    """Add the ``slots [intersections,SUMS]`` of some Gaussians to ``sums [m,SUMS]``, in the order of the lists."""
