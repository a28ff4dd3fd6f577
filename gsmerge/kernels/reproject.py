"""Measure how far points are from where cameras saw them, and from the centres of pixels."""

from __future__ import annotations

from gsmerge.kernels.signature import COUNT, STATUS, f4, f8, i4, i8, native


@native(
    STATUS, points=f8("n", 3), views=i8("n"), viewmats=f8("v", 4, 4), Ks=f8("v", 3, 3), pixels=f8("n", 2),
    errors=f8("n", out=True),
)  # fmt: skip
def pixel_errors(points, views, viewmats, Ks, pixels, errors):
    """Write the distances, pixels, between pixels and the projections of points into one view each.

    They are inf behind a camera.
    """


@native(
    points=f4("n", 3), viewmats=f8("v", 4, 4), Ks=f8("v", 3, 3), ids=i8("n", out=True),
    squares=f8("n", out=True), seen=i4("n", out=True), width=i8(least=1), height=i8(least=1),
)  # fmt: skip
def nearest_centres(points, viewmats, Ks, ids, squares, seen, width, height):
    """Write the pixel ``(view·H + y)·W + x`` whose centre each point projects nearest to, of all views.

    Also the square of that distance, pixels, and in how many pictures the point lies; -1 and inf for 0.
    """


@native(
    COUNT, points=f4("n", 3), viewmats=f8("v", 4, 4), Ks=f8("v", 3, 3), ids=i8("n", out=True),
    tails=i8("n", out=True), ends=i4("n", out=True), before=i4("m", out=True), keys=i8("v", out=True),
    views=i4("v", out=True), width=i8(least=1), height=i8(least=1), mixed=i4(least=0, most=1),
)  # fmt: skip
def follow_pixels(points, viewmats, Ks, ids, tails, ends, before, keys, views, width, height, mixed):
    """Write the pixel of each point, -1 for none, so that as many as possible come in the order of the pixels.

    That is view by view and line by line, or if ``mixed`` line by line with the views of a pixel side by side. Returns
    how many have one; arrays after ``ids`` are scratch, ``before`` of n·v values.
    """


@native(
    STATUS, points=f8("n", 3), pixels=f8("n", 2), K=f8(3, 3), pose=f8(4, 4), jacobian=f8("rows", "size", out=True),
    residuals=f8("rows", out=True),
)  # fmt: skip
def linearise(points, pixels, K, pose, jacobian, residuals):
    """Write the projection errors of a view's points, and their derivatives by motions of the camera.

    ``residuals [2n]``: errors to the right for all points, then errors downwards. Columns of ``jacobian [2n,6+f]``:
    rotation and shift of the camera; with f = 1 the logarithm of the focal length, with f = 2 those of both focal
    lengths, with f = 4 also the principal point.
    """
