"""Pack Gaussians as whole numbers for a page.

Each number is stored as the difference from the row before, with the sign in the lowest bit.
"""

from __future__ import annotations

from gsmerge.method.kernels.signature import STATUS, f4, f8, i4, i8, native, u4

LOOKS = 10  # number of columns before the columns of the harmonics


@native(
    STATUS, rows=i8("m", least=0, below="n"), opacities=f4("n", 1), sh0=f4("n", 3), scales=f4("n", 3), quats=f4("n", 4),
    shN=f4("n", "stored"), sh_scale=f8(), color_scale=f8(), steps=i4(3, least=1), levels=f8(),
    out=u4("columns", "m", out=True),
)  # fmt: skip
def pack_looks(rows, opacities, sh0, scales, quats, shN, sh_scale, color_scale, steps, levels, out):
    """Pack opacities, colours, scales and rotations of the Gaussians ``rows`` as in a ``.spz``, but more coarsely.

    Args:
        sh_scale: Factor from ``sh0`` to colours.
        color_scale: Scale of the colours in a ``.spz``.
        steps: ``[3]`` int32 steps of opacities, colours and log scales, in steps of a ``.spz``.
        levels: Number of steps from 0 to 1 for rotations. A rotation is stored as its axis times the tangent of a
            quarter of its angle, from -1 to 1.
        out: Written: columns of opacity, red minus green, green, blue minus green, three log scales and three numbers
            of the rotation. The remaining columns are harmonics.
    """


@native(
    i8(), rows=i8("m", least=0, below="n"), ids=i8("n"), means=f4("n", 3), viewmats=f8("views", 4, 4),
    Ks=f8("views", 3, 3), width=i8(least=1), height=i8(least=1), pixel_parts=f8(), depth_parts=f8(),
    out=u4(4, "m", out=True),
)  # fmt: skip
def pack_pixels(rows, ids, means, viewmats, Ks, width, height, pixel_parts, depth_parts, out):
    """Pack the positions of the Gaussians ``rows`` relative to their pixels, and return the number of packed rows.

    The first row that is not in front of its camera ends the packing.

    Args:
        ids: ``[n]`` int64 pixels of all Gaussians, numbered through all views.
        pixel_parts: Number of steps per pixel.
        depth_parts: Number of steps per unit of the logarithm of a depth.
        out: Written: columns of the pixel, of the shifts right and down from its centre, and of the log depth.
    """
