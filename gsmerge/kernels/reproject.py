"""Project points into views: measure distances from their pixels, and mark pixels."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import COUNT, STATUS, declare, f4, f8, i4, i8, native, u1


@native(
    STATUS, points=f8("n", 3), views=i8("n"), viewmats=f8("v", 4, 4), Ks=f8("v", 3, 3), pixels=f8("n", 2),
    errors=f8("n", out=True),
)  # fmt: skip
def pixel_errors(points, views, viewmats, Ks, pixels, errors):
    """Write the distances, pixels, between each point's projection into its view and its pixel.

    They are inf for points behind the camera.
    """


@native(points=f8("n", 3), viewmat=f8(4, 4), K=f8(3, 3), near=f8(), hit=u1("height", "width", out=True))
def mark_pixels(points, viewmat, K, near, hit):
    """Write 1 to the pixels of a view in which points beyond the depth ``near`` lie; other pixels stay unchanged."""


_see_points = declare(
    "see_points", points=f8("n", 3), viewmats=f8("v", 4, 4), Ks=f8("v", 3, 3),
    depths=f8("v", "lines", "columns"), width=f8(), height=f8(), near=f8(), behind=f8(),
    inside=u1("v", "n", out=True), seen=u1("v", "n", out=True),
)  # fmt: skip


def see_points(points, viewmats, Ks, depths, width, height, near, behind):
    """Return two masks ``[v,n]`` of points ``[n,3]``: inside the picture of each camera, and seen by each camera.

    Points inside lie farther than ``near``. Points are seen if they lie at most ``behind`` times as far as the depth of
    their cell, in a grid ``depths [v,lines,columns]`` over the picture.
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
    """Write the pixel of each point, -1 for none, so that as many points as possible are in the order of the pixels.

    Pixels are ordered by view, then by line. If ``mixed``, they are ordered by line and column, and the views of a
    pixel follow each other. Returns the number of points with a pixel. Arrays after ``ids`` are scratch; ``before`` has
    n·v values.
    """


@native(
    STATUS, points=f8("n", 3), pixels=f8("n", 2), K=f8(3, 3), pose=f8(4, 4), jacobian=f8("rows", "size", out=True),
    residuals=f8("rows", out=True),
)  # fmt: skip
def linearise(points, pixels, K, pose, jacobian, residuals):
    """Write the projection errors of a view's points, and their derivatives by motions of the camera.

    ``residuals [2n]`` are the errors to the right of all points, then the errors downwards. The columns of ``jacobian
    [2n,6+f]`` are rotation and shift of the camera, and f intrinsics: with f = 1 the logarithm of the focal length,
    with f = 2 the logarithms of both focal lengths, with f = 4 also the principal point.
    """
