"""The backward pass of projection: from sums over an image to means, rotations, scales and opacities.

The chain of :mod:`gsmerge.kernels.raster.project` backwards (EWA: Zwicker et al. 2001; the derivatives as in Ye et al.,
"Mathematical supplement for the gsplat library", 2023): footprint, half axes, rotation and scale, and the mean
through its image position and through the projection's derivative.
"""

from __future__ import annotations

from gsmerge.kernels.raster.blend_backward import SUMS
from gsmerge.kernels.raster.project import CAMERA
from gsmerge.kernels.signature import STATUS, f4, i4, i8, native

BLOCK = 128
POSE = 12  # numbers of a world-to-camera matrix: rotation (9, row by row), shift (3)


@native(
    STATUS, means=f4("n", 3), quats=f4("n", 4), scales=f4("n", 3), opacities=f4("n"), ids=i4("m"), sums=f4("m", SUMS),
    camera=f4(CAMERA), first=i8(least=0, most="m"), last=i8(least="first", most="m"),
    grad_means=f4("m", 3, out=True), grad_quats=f4("m", 4, out=True), grad_scales=f4("m", 3, out=True),
    grad_opacities=f4("m", out=True), grad_poses=f4("blocks", POSE, out=True, optional=True),
)  # fmt: skip
def project_backward(
    means, quats, scales, opacities, ids, sums, camera, first, last,
    grad_means, grad_quats, grad_scales, grad_opacities, grad_poses,
):  # fmt: skip
    """Write the gradients of a range of the listed Gaussians.

    Args:
        sums: ``[m,SUMS]`` float32, see :mod:`gsmerge.kernels.raster.blend_backward`.
        first: Start of the range, a multiple of BLOCK.
        last: End of the range, exclusive.
        grad_means: ``[m,3]`` float32, written.
        grad_quats: ``[m,4]`` float32, written.
        grad_scales: ``[m,3]`` float32, written.
        grad_opacities: ``[m]`` float32, written.
        grad_poses: ``[blocks,POSE]`` float32, written: gradient of the world-to-camera matrix, summed over blocks of
            BLOCK Gaussians; None for none.
    """


@native(STATUS, ids=i4("m"), rows=f4("m", "c"), totals=f4("n", "c", out=True))
def add_rows(ids, rows, totals):
    """Add ``rows [m,c]`` to ``totals [n,c]`` at the ``ids [m]`` int32."""
