"""Projection of Gaussians into one view: culling, EWA footprints, tile boxes.

The conventions are those of gsplat: 0.3 px dilation, footprints from the first-order (EWA) projection with the
direction clamped 15 % outside the image, no contribution below 1/255. A footprint is stored with its square
completed, so that the exponent of a pixel is never positive, however thin the Gaussian::

    ln w(x, y) = lnop - (rate_x (x - mean_x - slope (y - mean_y)))^2 - rate_y (y - mean_y)^2
"""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import STATUS, f4, i2, i4, i8, native, u1

TILE = 16  # pixels per side; one row of a tile is one AVX-512 vector
FOOTPRINT = 8  # numbers per footprint: mean_x, mean_y, rate_x, slope, rate_y, lnop, first row, last row
LN_CUT = np.float32(np.log(1 / 255))  # ln of the smallest weight that is drawn

# Positions in the camera's array of numbers.
ROTATION, SHIFT, FX, FY, CX, CY, WIDTH, HEIGHT, NEAR, FAR, EPS2D = 0, 9, 12, 13, 14, 15, 16, 17, 18, 19, 20
LIMIT_X, LIMIT_Y, ANTIALIASED = 21, 23, 25
CAMERA = 26


@native(
    i8(), means=f4("n", 3), scales=f4("n", 3), opacities=f4("n"), keep=u1("n", optional=True),
    wanted=i4("lines", "columns", optional=True), camera=f4(CAMERA), start=i4(), ids=i4("n", out=True),
)  # fmt: skip
def cull(means, scales, opacities, keep, wanted, camera, start, ids):
    """List the Gaussians that may touch the image -> their number.

    Args:
        keep: ``[n]`` uint8, 0 drops a Gaussian; None keeps all.
        wanted: ``[lines + 1, columns + 1]`` int32: the number of tiles above and left of each corner that a Gaussian
            has to touch one of; None wants all.
        start: What the first Gaussian is called.
        ids: ``[n]`` int32, the first ones are written: ascending.
    """


@native(
    STATUS, means=f4("n", 3), quats=f4("n", 4), scales=f4("n", 3), opacities=f4("n"), ids=i4("m"), camera=f4(CAMERA),
    footprints=f4("m", FOOTPRINT, out=True), depths=f4("m", out=True), boxes=i2("m", 4, out=True),
)  # fmt: skip
def project(means, quats, scales, opacities, ids, camera, footprints, depths, boxes):
    """Project the listed Gaussians.

    Args:
        quats: ``[n,4]`` wxyz; normalised here.
        opacities: ``[n]``; above 1 they count as 1.
        footprints: ``[m,FOOTPRINT]`` float32, written.
        depths: ``[m]`` float32, written: camera z.
        boxes: ``[m,4]`` int16, written: first and (exclusive) last tile column, first and last tile row; all 0
            where nothing is drawn.
    """
