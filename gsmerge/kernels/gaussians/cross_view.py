"""Agreement of points with the Gaussians of other views, one per pixel: each view is read at one pixel."""

from __future__ import annotations

import math

import numpy as np

from gsmerge.kernels.jit import kernel

COLUMNS = 6


@kernel
def sum_cross_view(
    points, colors, own, viewmats, Ks, width, height, means, opacities, sh0, color_scale, near, far, min_opacity,
    first, last, out,
):  # fmt: skip
    """Sums over the views that see each point.

    Args:
        points: ``[g,3]`` float64.
        colors: ``[g,3]`` float32 base colours less a half.
        own: ``[g]`` int64 view of each, which is left out.
        viewmats: ``[v,4,4]`` float64.
        Ks: ``[v,3,3]`` float64.
        means: ``[v h w,3]`` float32 Gaussians, one per pixel.
        opacities: ``[v h w]`` float32.
        sh0: ``[v h w,1,3]`` float32.
        near: Largest difference of the logarithms of two depths of one surface.
        far: Larger differences are clipped to this.
        min_opacity: More transparent Gaussians show no surface.
        out: ``[g,6]`` float64, added to: views that see the point; of these, those whose surface is at it, behind it,
            in front of it; absolute difference of colours where it is at it, difference of the logarithms of depths.
    """
    for v in range(viewmats.shape[0]):  # views outside: neighbouring points read neighbouring pixels
        m, K = viewmats[v], Ks[v]
        for i in range(first, last):
            if v == own[i]:
                continue
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            if not depth > 1e-9:
                continue
            right = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
            down = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
            column = math.floor((K[0, 0] * right + K[0, 1] * down + K[0, 2] * depth) / depth)
            row = math.floor((K[1, 1] * down + K[1, 2] * depth) / depth)
            if not (0 <= column < width and 0 <= row < height):
                continue
            j = (v * height + int(row)) * width + int(column)
            there = m[2, 0] * means[j, 0] + m[2, 1] * means[j, 1] + m[2, 2] * means[j, 2] + m[2, 3]
            if not (there > 0 and opacities[j] > min_opacity):
                continue
            ratio = math.log(depth / there)
            out[i, 0] += 1
            if abs(ratio) < near:
                out[i, 1] += 1
                for c in range(3):
                    out[i, 4] += abs(np.float64(colors[i, c]) - color_scale * sh0[j, 0, c]) / 3
            elif ratio < 0:
                out[i, 2] += 1
            else:
                out[i, 3] += 1
            out[i, 5] += min(max(ratio, -far), far)
