"""Find the pixels of Gaussians by projecting their centres, without drawing a picture.

A Gaussian whose centre is outside of a picture, but which reaches into it, belongs to the nearest pixel. A Gaussian
with its centre outside hides no other Gaussian at this pixel, and is not in front at any pixel.
"""

from __future__ import annotations

import numpy as np

from gsmerge.method.kernels.signature import COUNT, STATUS, declare, f4, f8, i4, i8

_project_centres = declare(
    "project_centres", COUNT, means=f4("n", 3), scales=f4("n", 3), viewmat=f8(4, 4), K=f8(3, 3),
    width=i8(least=0, below=1 << 15), height=i8(least=0, below=1 << 15), near=f8(), ids=i4("n", out=True),
    pixels=i4("n", out=True), depths=f4("n", out=True), areas=f4("n", out=True),
)  # fmt: skip
_weigh_centres = declare(
    "weigh_centres", STATUS, order=i4("some"), ids=i4("m"), pixels=i4("m"), areas=f4("m"), opacities=f4("n"),
    passing=f4("h", "w", out=True), most=f4("h", "w", out=True), fronts=i4("h", "w", out=True),
    weights=f4("m", out=True),
)  # fmt: skip


def project_centres(means, scales, viewmat, K, width, height, near):
    """Project the centres of Gaussians into a picture, and find the Gaussians that reach into the picture.

    Args:
        viewmat: ``[4,4]`` float64, world to camera.
        width: Width of the picture, pixels.
        height: Height of the picture, pixels.
        near: Depth in world units up to which Gaussians are left out.

    Returns:
        Rows ``[m]`` int32, ascending, pixels ``[m]`` int32, depths ``[m]`` float32 and areas ``[m]`` float32 of the m
        Gaussians that reach into the picture. An area is the product of the two longest axes in square pixels. If the
        centre is outside of the picture, the area is multiplied by the Gaussian's falloff at the border, and negative.
    """
    n = len(means)
    ids, pixels, depths, areas = (np.empty(n, kind) for kind in (np.int32, np.int32, np.float32, np.float32))
    m = _project_centres(means, scales, viewmat, K, width, height, near, ids, pixels, depths, areas)
    return tuple(array[:m].copy() for array in (ids, pixels, depths, areas))


def weigh_centres(order, ids, pixels, areas, opacities, fronts):
    """Compute the weights of Gaussians at the pixels of their centres, which may also be cells of a coarser grid.

    Args:
        order: ``[k]`` int32 positions, from 0 to m - 1, of the Gaussians to weigh, nearest first.
        ids: ``[m]`` int32 rows of the Gaussians.
        pixels: ``[m]`` int32 pixel of each Gaussian, which is ``row * w + column``.
        areas: ``[m]`` float32, see :func:`project_centres`.
        opacities: ``[n]`` float32 of all Gaussians.
        fronts: ``[h,w]`` int32, written: row of the Gaussian with the largest opacity times transmittance at each
            pixel, or -1 if there is none.

    Returns:
        Opacity times transmittance times area ``[m]`` float32, and 0 for Gaussians that are not in ``order``.
    """
    weights = np.zeros(len(ids), np.float32)
    passing = np.ones(fronts.shape, np.float32)
    fronts[:] = -1
    _weigh_centres(order, ids, pixels, areas, opacities, passing, np.zeros_like(passing), fronts, weights)
    return weights
