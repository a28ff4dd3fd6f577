"""Compare pixels of one view with what another view shows."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import COUNT, STATUS, declare, f4, f8, i8, native, u1

SCRATCH_COLUMNS = 10  # values of scratch per pixel


@native(
    STATUS, points=f8("n", 3), greys=f4("p", "room"), starts=i8("ends", least=0, most="n", ascending=True),
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
    """Compare pixels of one view with the photo of another, for the pairs of views ``first`` to ``last``.

    Pixels are given as ``points`` in the frame of their camera. The pixels of view i have the rows ``starts[i]`` to
    ``starts[i + 1]``.

    Args:
        greys: For each pair, the grey levels that the second view should show at the pixels of the first.
        pictures: Grey level, and its derivatives to the right and down; pixels nearer than ``border`` to the edge of a
            picture are not used.
        depths: Depths of the Gaussians at the pixels' centres; NaN without any.
        given: Poses from which ``flows`` are measured.
        scale: Unit of ``flows`` per pixel.
        scratch: ``[SCRATCH_COLUMNS, largest number of pixels of a view]``.
        curvatures: Written: Gauss-Newton's second derivatives of half the weighted squared differences with respect to
            a motion of the second camera; ``slopes`` gets the first derivatives.
        costs: Written: mean over the pixels of a robust function of their differences.
        flows: Written: median distances between the pixels' projections with the present poses and with ``given``.
    """


_find_surfaces = declare(
    "find_surfaces", COUNT, means=f4("pixels", 3), rows=i8("n"), others=f4("size", 3), valid=u1("size"),
    viewmat=f8(4, 4), K=f8(3, 3), width=i8(least=1), near=f8(), same=f8(), ids=i8("n", out=True),
    places=i8("n", out=True),
)  # fmt: skip


def find_surfaces(means, rows, others, valid, viewmat, K, width, near, same):
    """Find the pixels ``rows`` of a view whose surface another view shows too.

    ``means`` and ``others`` are the points ``[pixels,3]`` of the pixels of both views. A pixel shows the same surface
    if the other view's point is ``valid`` and the logarithms of the two depths differ by less than ``same``. Returns
    the positions of these pixels within ``rows``, and the matching pixels of the other view.
    """
    ids, places = np.empty((2, len(rows)), np.int64)
    count = _find_surfaces(means, rows, others, valid.view(np.uint8), viewmat, K, width, near, same, ids, places)
    return ids[:count], places[:count]


@native(
    STATUS, picture=f4("h", "w", 3), along=f8(3, "n"), start=f8(3), depths=f8("n"), colors=f4("n", 3), pixels=i8("n"),
    sums=f4("height", "width", 2, out=True),
)  # fmt: skip
def add_differences(picture, along, start, depths, colors, pixels, sums):
    """Add to ``sums``, for ``pixels`` that a picture shows, the difference of their ``colors`` from it, and 1.

    The projections of the points, homogeneous in pixels of the picture, are ``start`` plus ``depths`` times ``along``.
    The three rows of ``along`` are the changes of column, row and depth.
    """
