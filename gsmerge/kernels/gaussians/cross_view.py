"""Agreement of points with the Gaussians of other views, one per pixel: each view is read at one pixel."""

from __future__ import annotations

from gsmerge.kernels.signature import STATUS, f4, f8, i8, native

COLUMNS = 6


@native(
    STATUS, points=f8("g", 3), colors=f4("g", 3), own=i8("g"), viewmats=f8("views", 4, 4), Ks=f8("views", 3, 3),
    width=i8(least=0, below=1 << 31), height=i8(least=0, below=1 << 31), means=f4("n", 3), opacities=f4("n"),
    sh0=f4("n", 1, 3), color_scale=f8(), near=f8(), far=f8(), min_opacity=f8(), first=i8(least=0), last=i8(),
    out=f8("g", COLUMNS, out=True),
)  # fmt: skip
def sum_cross_view(
    points, colors, own, viewmats, Ks, width, height, means, opacities, sh0, color_scale, near, far, min_opacity,
    first, last, out,
):  # fmt: skip
    """Sum over the views that see each point, for the points from ``first`` to before ``last``.

    Args:
        points: ``[g,3]`` float64.
        colors: ``[g,3]`` float32 base colours less a half.
        own: ``[g]`` int64 view of each, which is left out.
        viewmats: ``[v,4,4]`` float64.
        Ks: ``[v,3,3]`` float64.
        width: Of the views, pixels.
        height: Of the views, pixels.
        means: ``[v h w,3]`` float32 Gaussians, one per pixel.
        opacities: ``[v h w]`` float32.
        sh0: ``[v h w,1,3]`` float32.
        color_scale: From ``sh0`` to colours.
        near: Largest difference of the logarithms of two depths of one surface.
        far: Larger differences are clipped to this.
        min_opacity: More transparent Gaussians show no surface.
        first: Of the points.
        last: After the last point.
        out: ``[g,6]`` float64, added to: views that see the point; of these, those whose surface is at it, behind it,
            in front of it; absolute difference of colours where it is at it, difference of the logarithms of depths.
    """
