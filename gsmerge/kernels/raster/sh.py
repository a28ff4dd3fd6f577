"""Evaluate spherical harmonics, to get the colours that Gaussians show to a camera, and gradients of the colours."""

from __future__ import annotations

from gsmerge.kernels.signature import STATUS, f4, i4, i8, native


@native(
    STATUS, means=f4("n", 3), sh0=f4("n", 1, 3), shN=f4("n", "num", 3), ids=i4("m"), eye=f4(3),
    first=i8(least=0, most="m"), last=i8(least="first", most="m"), colors=f4("m", 3, out=True),
)  # fmt: skip
def view_colors(means, sh0, shN, ids, eye, first, last, colors):
    """Write the colours of a range of the listed Gaussians as seen from ``eye [3]``, at least 0."""


@native(
    STATUS, means=f4("n", 3), shN=f4("n", "num", 3), ids=i4("m"), eye=f4(3), first=i8(least=0, most="m"),
    last=i8(least="first", most="m"), colors=f4("m", 3), grad_colors=f4("m", 3), grad_sh0=f4("m", 1, 3, out=True),
    grad_shN=f4("m", "num", 3, out=True), grad_means=f4("m", 3, out=True),
)  # fmt: skip
def view_colors_backward(means, shN, ids, eye, first, last, colors, grad_colors, grad_sh0, grad_shN, grad_means):
    """Run the backward pass of :func:`view_colors` for a range of the listed Gaussians.

    Args:
        colors: ``[m,3]`` float32 colours of :func:`view_colors`. No gradient passes where they are 0.
        grad_means: ``[m,3]`` float32, written: gradient through the direction in which the eye sees the Gaussian.
    """
