"""The backward pass of view-dependent colours: to the coefficients and, through the viewing direction, to the means."""

from __future__ import annotations

import numpy as np
from numpy import float32 as f4

from gsmerge.kernels.jit import kernel

BLOCK = 128
# Planes of a block. In: direction 0-2 (any length), dots 4 on: per higher harmonic its coefficients times the colour's
# gradient. Out, in their place: gradient of the mean, values of the harmonics.
P = tuple(np.uint64(BLOCK * plane) for plane in range(28 + 3))
X, Y, Z, INVERSE, DOTS, UNIT = 0, 1, 2, 3, 3, 28  # plane DOTS + k belongs to harmonic k >= 1


@kernel
def _first_degree(block):
    """Unit directions, their inverse lengths, and degree 1."""
    c = f4(0.4886025119029199)
    for lane in range(BLOCK):
        i = np.uint64(lane)
        x, y, z = block[i + P[X]], block[i + P[Y]], block[i + P[Z]]
        square = x * x + y * y + z * z
        seen = square > f4(0.0)
        inverse = f4(1.0) / np.sqrt(square if seen else f4(1.0))
        inverse = inverse if seen else f4(0.0)
        x, y, z = x * inverse, y * inverse, z * inverse
        block[i + P[UNIT]], block[i + P[UNIT + 1]], block[i + P[UNIT + 2]] = x, y, z
        block[i + P[X]] = -c * block[i + P[DOTS + 3]]
        block[i + P[Y]] = -c * block[i + P[DOTS + 1]]
        block[i + P[Z]] = c * block[i + P[DOTS + 2]]
        block[i + P[INVERSE]] = inverse
        block[i + P[DOTS + 1]], block[i + P[DOTS + 2]], block[i + P[DOTS + 3]] = -c * y, c * z, -c * x
