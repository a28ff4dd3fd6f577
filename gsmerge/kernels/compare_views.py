"""Compare pixels of one view with what another view shows."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import COUNT, STATUS, declare, f4, f8, i8, native, u1

COLUMNS = 10  # of scratch


@native(
    STATUS, points=f8("n", 3), greys=f4("n"), starts=i8("ends", least=0, most="n", ascending=True),
    pairs=i8("p", 2, least=0, below="v"), viewmats=f8("v", 4, 4), given=f8("v", 4, 4), Ks=f8("v", 3, 3),
    pictures=f4("v", "h", "w", 3),
    depths=f8("v", "h", "w"), near=f8(), border=f8(), scale=f8(), first=i8(least=0), last=i8(most="p"),
    scratch=f8("columns", "room", out=True), order=i8("room", out=True), curvatures=f8("p", 6, 6, out=True),
    slopes=f8("p", 6, out=True), costs=f8("p", out=True), flows=f8("p", out=True),
)  # fmt: skip
def compare_views(
    points, greys, starts, pairs, viewmats, given, Ks, pictures, depths, near, border, scale, first, last, scratch,
    order, curvatures, slopes, costs, flows,
):  # fmt: skip
    """Write how far the pixels of one view disagree with the photo of another, for the pairs ``first`` to ``last``.

    Pixels are ``points`` in their camera's frame, with their ``greys``; view i has ``starts[i]`` to ``starts[i + 1]``.

    Args:
        pictures: Grey, and how it changes to the right and down; looked up no nearer than ``border`` to its rim.
        depths: Of the Gaussians at the pixels' middles; NaN where there is none.
        given: Poses that ``flows``, in ``scale`` a pixel, are measured from.
        scratch: ``[COLUMNS, most pixels of a view]``.
        curvatures: Of half the squared differences by a motion of the second camera, with their ``slopes``.
        costs: Means over the pixels of how much they disagree.
        flows: Median distances of the pixels.
    """


_find_surfaces = declare(
    "find_surfaces", COUNT, means=f4("pixels", 3), rows=i8("n"), others=f4("size", 3), valid=u1("size"),
    viewmat=f8(4, 4), K=f8(3, 3), width=i8(least=1), near=f8(), same=f8(), ids=i8("n", out=True),
    places=i8("n", out=True),
)  # fmt: skip


def find_surfaces(means, rows, others, valid, viewmat, K, width, near, same):
    """Find which pixels ``rows`` of a view show a surface that another view shows: their places, and the pixels there.

    Pixels of both have points ``[pixels,3]``; those of the ``others`` count where they are ``valid``, and where the
    logarithms of the two depths differ by less than ``same``.
    """
    ids, places = np.empty((2, len(rows)), np.int64)
    count = _find_surfaces(means, rows, others, valid.view(np.uint8), viewmat, K, width, near, same, ids, places)
    return ids[:count], places[:count]


@native(
    STATUS, picture=f4("h", "w", 3), along=f8(3, "n"), start=f8(3), depths=f8("n"), colors=f4("n", 3), pixels=i8("n"),
    sums=f4("height", "width", 2, out=True),
)  # fmt: skip
def add_differences(picture, along, start, depths, colors, pixels, sums):
    """Add to ``sums`` at some ``pixels`` how far their ``colors`` are from a picture, and one, where it shows them.

    Points lie at ``start`` and ``depths`` times ``along`` in a camera whose intrinsics are applied: columns, rows and
    depths, one array after the other.
    """
