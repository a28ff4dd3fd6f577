"""Project points into views, to measure how far they are from their pixels, or to find which views see them."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import COUNT, STATUS, declare, f4, f8, i4, i8, native, u1


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
    views=i4("v", out=True), width=i8(least=1), height=i8(least=1), mixed=i4(least=0, most=1),
)  # fmt: skip
def follow_pixels(points, viewmats, Ks, ids, tails, ends, before, keys, views, width, height, mixed):
    """Choose pixels of points so that the order of as many points as possible is the order of their pixels.

    A point may project into several views. The chosen pixels are written to ``ids``, and -1 for points without a pixel.
    Returns the number of points with a pixel. Pixels are ordered by view and then by line. If ``mixed`` is 1, pixels
    are ordered by line and column, and then by view. The arrays from ``tails`` to ``views`` are scratch, of which
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
