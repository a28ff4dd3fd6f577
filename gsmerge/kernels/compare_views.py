"""Compare the pixels of one view with what another view shows at the same places."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import COUNT, STATUS, declare, f4, f8, i8, native, u1

SCRATCH_COLUMNS = 10  # numbers of scratch for each pixel


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
    """Compare pixels of one view with the photo of another, for the pairs of views from ``first`` to before ``last``.

    A pixel is given by its point in the frame of its camera. The points of view i are the rows from ``starts[i]`` to
    before ``starts[i + 1]``.

    Args:
        greys: For each pair, the grey levels that the second view should show at the pixels of the first.
        pictures: Grey level, and its derivatives to the right and down. Pixels less than ``border`` from a side of
            the picture are not used.
        depths: Depths of the Gaussians at the centres of the pixels; NaN where there are none.
        given: Poses before any motion, relative to which ``flows`` are measured.
        scale: Factor from pixels to the unit of ``flows``.
        scratch: ``[SCRATCH_COLUMNS, largest number of pixels of a view]``.
        curvatures: Written: second derivatives, by Gauss-Newton, of half the weighted squared differences by a motion
            of the second camera; ``slopes`` gets the first derivatives.
        costs: Written: mean over the pixels of a robust function of their differences.
        flows: Written: median distance of the pixels' projections with ``viewmats`` from those with ``given``.
    """


_find_surfaces = declare(
    "find_surfaces", COUNT, means=f4("pixels", 3), rows=i8("n"), others=f4("size", 3), valid=u1("size"),
    viewmat=f8(4, 4), K=f8(3, 3), width=i8(least=1), near=f8(), same=f8(), ids=i8("n", out=True),
    places=i8("n", out=True),
)  # fmt: skip


def find_surfaces(means, rows, others, valid, viewmat, K, width, near, same):
    """Find those pixels, among ``rows`` of a view, whose surface another view shows too.

    ``means`` and ``others`` are the points of all pixels of the two views. Two pixels show the same surface if the
    other view's point is ``valid``, and the logarithms of both depths differ by less than ``same``. Returns the
    positions of the pixels within ``rows``, and the matching pixels of the other view.
    """
    ids, places = np.empty((2, len(rows)), np.int64)
    count = _find_surfaces(means, rows, others, valid.view(np.uint8), viewmat, K, width, near, same, ids, places)
    return ids[:count], places[:count]


@native(
    STATUS, picture=f4("h", "w", 3), along=f8(3, "n"), start=f8(3), depths=f8("n"), colors=f4("n", 3), pixels=i8("n"),
    sums=f4("height", "width", 2, out=True),
)  # fmt: skip
def add_differences(picture, along, start, depths, colors, pixels, sums):
    """Add to ``sums``, for those ``pixels`` that a picture shows, the difference of their ``colors`` from it, and 1.

    The homogeneous coordinates of the points, in pixels of the picture, are ``start`` plus ``depths`` times ``along``.
    Their three numbers are column times depth, row times depth, and depth.
    """
