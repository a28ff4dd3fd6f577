"""Measure how far points are from where cameras saw them."""

from __future__ import annotations

from gsmerge.kernels.signature import STATUS, f8, i8, native


@native(
    STATUS, points=f8("n", 3), views=i8("n"), viewmats=f8("v", 4, 4), Ks=f8("v", 3, 3), pixels=f8("n", 2),
    errors=f8("n", out=True),
)  # fmt: skip
def pixel_errors(points, views, viewmats, Ks, pixels, errors):
    """Write the distances, pixels, between pixels and the projections of points into one view each.

    They are inf behind a camera.
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
