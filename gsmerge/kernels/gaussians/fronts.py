"""Pixels of Gaussians by projection of their centres: no picture is drawn.

A Gaussian whose centre lies outside a picture into which it reaches may belong to the nearest pixel; it hides nothing
there, and no pixel shows it.
"""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.raster.binning import depth_order
from gsmerge.kernels.signature import COUNT, STATUS, declare, f4, f8, i4, i8

_project_centres = declare(
    "project_centres", COUNT, means=f4("n", 3), scales=f4("n", 3), viewmat=f8(4, 4), K=f8(3, 3),
    width=i8(least=0, below=1 << 15), height=i8(least=0, below=1 << 15), near=f8(), ids=i4("n", out=True),
    pixels=i4("n", out=True), depths=f4("n", out=True), areas=f4("n", out=True),
)  # fmt: skip
_weigh_centres = declare(
    "weigh_centres", STATUS, order=i4("m"), ids=i4("m"), pixels=i4("m"), areas=f4("m"), opacities=f4("n"),
    passing=f4("h", "w", out=True), most=f4("h", "w", out=True), fronts=i4("h", "w", out=True),
    weights=f4("m", out=True),
)  # fmt: skip


def weigh_centres(means, scales, opacities, viewmat, K, near, fronts):
    """Weigh Gaussians at the pixels of their centres, nearest first; of equal depths the first row comes first.

    Args:
        viewmat: ``[4,4]`` float64, world to camera.
        near: Depth beyond which Gaussians count, world units.
        fronts: ``[h,w]`` int32, written: the Gaussian with the largest opacity times transmittance at each pixel, -1
            without any.

    Returns:
        Of the m Gaussians that reach into the picture: their rows ``[m]`` int32, ascending; their pixels ``[m]`` int32;
        and ``[m]`` float32 opacity times transmittance times area: the product of the two longest axes in pixels, times
        the falloff up to the picture where the centre is outside.
    """
    (height, width), n = fronts.shape, len(means)
    ids, pixels, depths, areas = (np.empty(n, kind) for kind in (np.int32, np.int32, np.float32, np.float32))
    m = _project_centres(means, scales, viewmat, K, width, height, near, ids, pixels, depths, areas)
    ids, pixels, depths, areas = (array[:m].copy() for array in (ids, pixels, depths, areas))
    weights, passing = np.empty(m, np.float32), np.ones((height, width), np.float32)
    fronts[:] = -1
    order = depth_order(depths.view(np.uint32))
    _weigh_centres(order, ids, pixels, areas, opacities, passing, np.zeros_like(passing), fronts, weights)
    return ids, pixels, weights
