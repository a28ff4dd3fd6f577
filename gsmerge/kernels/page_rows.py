"""Gaussians as the whole numbers of a page: columns of steps, each less that of the row before, the sign lowest."""

from __future__ import annotations

from gsmerge.kernels.signature import STATUS, f4, f8, i4, i8, native, u4

LOOKS = 10  # columns before the harmonics


@native(
    STATUS, rows=i8("m", least=0, below="n"), opacities=f4("n", 1), sh0=f4("n", 3), scales=f4("n", 3), quats=f4("n", 4),
    shN=f4("n", "stored"), sh_scale=f8(), color_scale=f8(), steps=i4(3, least=1), levels=f8(),
    out=u4("columns", "m", out=True),
)  # fmt: skip
def pack_looks(rows, opacities, sh0, scales, quats, shN, sh_scale, color_scale, steps, levels, out):
    """Pack what the Gaussians ``rows`` look like, as the numbers of a ``.spz`` in coarser steps.

    Args:
        sh_scale: From ``sh0`` to colours.
        color_scale: Of a ``.spz``.
        steps: ``[3]`` int32 of opacities, colours and log scales.
        levels: Of a rotation: tangents of a quarter of its angle, along its axis, are from -1 to 1 times that.
        out: Columns of opacity, red less green, green, blue less green, log scales, rotation, and as many harmonics
            as there is room for.
    """


@native(
    i8(), rows=i8("m", least=0, below="n"), ids=i8("n"), means=f4("n", 3), viewmats=f8("views", 4, 4),
    Ks=f8("views", 3, 3), width=i8(least=1), height=i8(least=1), pixel_parts=f8(), depth_parts=f8(),
    out=u4(4, "m", out=True),
)  # fmt: skip
def pack_pixels(rows, ids, means, viewmats, Ks, width, height, pixel_parts, depth_parts, out):
    """Pack where Gaussians of pixels are; return the number of rows before one that is not in front of its camera.

    Args:
        ids: ``[n]`` int64 among all pixels of all views.
        pixel_parts: Of a pixel.
        depth_parts: Of the logarithm of a depth.
        out: Columns of id, shifts right and down from the middle of the pixel, and log depth.
    """
