"""Measure how far points are from where cameras saw them."""

from __future__ import annotations

from gsmerge.kernels.signature import STATUS, f8, i8, native


@native(
    STATUS, points=f8("n", 3), views=i8("n"), viewmats=f8("v", 4, 4), Ks=f8("v", 3, 3), pixels=f8("n", 2),
    errors=f8("n", out=True),
)  # fmt: skip
def pixel_errors(points, views, viewmats, Ks, pixels, errors):
    """Write the distances, pixels, of points that are projected into one view each from pixels; inf behind a camera."""


@native(
    STATUS, points=f8("n", 3), pixels=f8("n", 2), K=f8(3, 3), pose=f8(4, 4), jacobian=f8("rows", "size", out=True),
    residuals=f8("rows", out=True),
)  # fmt: skip
def linearise(points, pixels, K, pose, jacobian, residuals):
    """Write how far points of a view are projected from their pixels, and how motions of the camera change that.

    ``residuals [2n]``: to the right for all points, then down. Columns of ``jacobian [2n,6+f]``: turn and shift of the
    camera, then of f = 1 the logarithm of the focal length, of 2 of both, of 4 the principal point as well.
    """
