"""Project points into views, to compare views and to find which views see the points, and at which pixels."""

from __future__ import annotations

import numpy as np

from gsmerge.method.kernels.signature import COUNT, STATUS, declare, f4, f8, i4, i8, native, u1

SCRATCH_COLUMNS = 10  # numbers of scratch for each pixel


@native(
    STATUS, points=f8("n", 3), views=i8("n"), viewmats=f8("v", 4, 4), Ks=f8("v", 3, 3), pixels=f8("n", 2),
    errors=f8("n", out=True),
)  # fmt: skip
def pixel_errors(points, views, viewmats, Ks, pixels, errors):
    """Write the distance, in pixels, between each point's projection into its view and its pixel to ``errors``.

    The distance is infinite if the point is behind the camera.
    """


@native(points=f8("n", 3), viewmat=f8(4, 4), K=f8(3, 3), near=f8(), hit=u1("height", "width", out=True))
def mark_pixels(points, viewmat, K, near, hit):
    """Write 1 to the pixels of ``hit`` that contain points beyond the depth ``near``, and change no other pixel."""


_see_points = declare(
    "see_points", points=f8("n", 3), viewmats=f8("v", 4, 4), Ks=f8("v", 3, 3),
    depths=f8("v", "lines", "columns"), width=f8(), height=f8(), near=f8(), behind=f8(),
    inside=u1("v", "n", out=True), seen=u1("v", "n", out=True),
)  # fmt: skip


def see_points(points, viewmats, Ks, depths, width, height, near, behind):
    """Return a mask ``[v,n]`` of ``points [n,3]`` inside each camera's picture, and a mask ``[v,n]`` of points seen.

    A point is inside only if its depth is more than ``near``. A point inside is seen if its depth is at most ``behind``
    times the depth of the surface at its projection. ``depths [v,lines,columns]`` are the depths of surfaces in a grid
    of cells over each picture.
    """
    inside, seen = np.empty((2, len(viewmats), len(points)), bool)
    masks = inside.view(np.uint8), seen.view(np.uint8)
    _see_points(points, viewmats, Ks, depths, float(width), float(height), near, behind, *masks)
    return inside, seen


@native(
    COUNT, points=f4("n", 3), viewmats=f8("v", 4, 4), Ks=f8("v", 3, 3), ids=i8("n", out=True),
    tails=i8("n", out=True), ends=i4("n", out=True), before=i4("m", out=True), keys=i8("v", out=True),
    views=i4("v", out=True), hints=i8("v", out=True), width=i8(least=1), height=i8(least=1),
    mixed=i4(least=0, most=1),
)  # fmt: skip
def follow_pixels(points, viewmats, Ks, ids, tails, ends, before, keys, views, hints, width, height, mixed):
    """Choose pixels of points so that the order of as many points as possible is the order of their pixels.

    A point may project into several views. The chosen pixels are written to ``ids``, and -1 for points without a pixel.
    Returns the number of points with a pixel. Pixels are ordered by view and then by line. If ``mixed`` is 1, pixels
    are ordered by line and column, and then by view. The arrays from ``tails`` to ``hints`` are scratch, of which
    ``before`` has n·v values.
    """


@native(
    STATUS, points=f8("n", 3), pixels=f8("n", 2), K=f8(3, 3), pose=f8(4, 4), jacobian=f8("rows", "size", out=True),
    residuals=f8("rows", out=True),
)  # fmt: skip
def linearise(points, pixels, K, pose, jacobian, residuals):
    """Write the reprojection errors of a view's points, and their derivatives with respect to camera parameters.

    ``residuals [2n]`` are the errors of all points to the right, then the errors downwards, in pixels. The columns of
    ``jacobian [2n,6+f]`` are derivatives with respect to the camera's rotation, its shift, and f intrinsics: the
    logarithm of the focal length (f = 1), or of both focal lengths (f = 2), and also the principal point (f = 4).
    """


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

    For each pair, sums over the pixels tell how the second camera has to move so that both pictures agree. A pixel is
    given by its point in the frame of its camera. The points of view i are the rows from ``starts[i]`` to before
    ``starts[i + 1]``.

    Args:
        greys: For each pair, the grey levels that the second view should show at the pixels of the first.
        pictures: Grey levels of the photos, and their derivatives to the right and down. Pixels less than ``border``
            pixels from a side of the photo are not used.
        depths: Depths of the Gaussians at the centres of the pixels, or NaN where there are none.
        given: View matrices before any motion, relative to which ``flows`` are measured.
        scale: Factor from pixels to the unit of ``flows``.
        scratch: ``[SCRATCH_COLUMNS, largest number of pixels of a view]`` float64.
        curvatures: Written: second derivatives of half the weighted squared differences with respect to a motion of
            the second camera, by Gauss-Newton.
        slopes: Written: first derivatives of the same sums.
        costs: Written: means over the pixels of a robust function of their differences.
        flows: Written: median distances between the projections of the pixels with ``viewmats`` and with ``given``.
    """


_find_surfaces = declare(
    "find_surfaces", COUNT, means=f4("pixels", 3), rows=i8("n"), others=f4("size", 3), valid=u1("size"),
    viewmat=f8(4, 4), K=f8(3, 3), width=i8(least=1), near=f8(), same=f8(), ids=i8("n", out=True),
    places=i8("n", out=True),
)  # fmt: skip


def find_surfaces(means, rows, others, valid, viewmat, K, width, near, same):
    """Find the pixels, among the pixels ``rows`` of a view, whose surface another view shows too.

    ``means`` are the points of all pixels of one view, and ``others`` of the other view. Two pixels show the same
    surface if the other view's point is ``valid``, and the logarithms of both depths differ by less than ``same``.
    Returns the positions in ``rows`` of the pixels whose surface the other view shows, and the pixels of the other
    view.
    """
    ids, pixels = np.empty((2, len(rows)), np.int64)
    count = _find_surfaces(means, rows, others, valid.view(np.uint8), viewmat, K, width, near, same, ids, pixels)
    return ids[:count], pixels[:count]


@native(
    STATUS, picture=f4("h", "w", 3), along=f8(3, "n"), start=f8(3), depths=f8("n"), colors=f4("n", 3), pixels=i8("n"),
    sums=f4("height", "width", 2, out=True),
)  # fmt: skip
def add_differences(picture, along, start, depths, colors, pixels, sums):
    """Add the differences of the ``colors`` of some ``pixels`` from another picture, and their number, to ``sums``.

    Pixels that the picture does not show add nothing. The homogeneous coordinates of a pixel's point in the picture are
    ``start`` plus its depth times ``along``: column times depth, row times depth, and depth.
    """
