"""The backward pass of projection: from sums over an image to means, rotations, scales and opacities.

The chain of :mod:`gsmerge.kernels.raster.project` backwards (EWA: Zwicker et al. 2001; the derivatives as in Ye et al.,
"Mathematical supplement for the gsplat library", 2023): footprint, half axes, rotation and scale, and the mean
through its image position and through the projection's derivative. Works on blocks like the forward pass.
"""

from __future__ import annotations

import numpy as np
from numpy import float32 as f4

from gsmerge.kernels.jit import kernel
from gsmerge.kernels.raster.project import (
    ANTIALIASED,
    EPS2D,
    FX,
    FY,
    LIMIT_X,
    LIMIT_Y,
    MAX_SIGMA,
    SHIFT,
    _between,
)

BLOCK = 128
POSE = 12  # numbers of a world-to-camera matrix: rotation (9, row by row), shift (3)
# Planes of a block. In: mean 0-2, quaternion 3-6, scales 7-9, sums over the image 10-18, opacity 19. Out, in their
# place: gradients of mean, quaternion and scales, of the opacity in 19, of the world-to-camera matrix in 20-31.
PLANES = 20 + POSE
P = tuple(np.uint64(BLOCK * plane) for plane in range(PLANES))


@kernel(part=True)
def dot(u, v):
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@kernel(part=True)
def mix(x, u, y, v):
    """Return x u + y v."""
    return x * u[0] + y * v[0], x * u[1] + y * v[1], x * u[2] + y * v[2]


@kernel(part=True)
def scaled(u, s):
    return u[0] * s[0], u[1] * s[1], u[2] * s[2]


@kernel(part=True)
def times(m, u):
    """Return the product of rows m and u."""
    return dot(m[0], u), dot(m[1], u), dot(m[2], u)


@kernel(part=True)
def transposed(m, u):
    """Return the product of the transpose of rows m and u."""
    return (
        m[0][0] * u[0] + m[1][0] * u[1] + m[2][0] * u[2],
        m[0][1] * u[0] + m[1][1] * u[1] + m[2][1] * u[2],
        m[0][2] * u[0] + m[1][2] * u[1] + m[2][2] * u[2],
    )


@kernel(part=True)
def rotation(w, x, y, z, h):
    """Rows of the rotation matrix of a unit quaternion; h is 2, or 0 for no rotation."""
    one = f4(1.0)
    return (
        (one - h * (y * y + z * z), h * (x * y - w * z), h * (x * z + w * y)),
        (h * (x * y + w * z), one - h * (x * x + z * z), h * (y * z - w * x)),
        (h * (x * z - w * y), h * (y * z + w * x), one - h * (x * x + y * y)),
    )


@kernel(part=True)
def rotation_backward(w, x, y, z, h, a, gc, b, gd):
    """Gradient of a quaternion, over h, from those of a M and b M, M its matrix: only what is across it."""
    g0, g1, g2 = mix(a[0], gc, b[0], gd), mix(a[1], gc, b[1], gd), mix(a[2], gc, b[2], gd)
    two = f4(2.0)
    gw = x * (g2[1] - g1[2]) + y * (g0[2] - g2[0]) + z * (g1[0] - g0[1])
    gx = w * (g2[1] - g1[2]) + y * (g0[1] + g1[0]) + z * (g0[2] + g2[0]) - two * x * (g1[1] + g2[2])
    gy = w * (g0[2] - g2[0]) + x * (g0[1] + g1[0]) + z * (g1[2] + g2[1]) - two * y * (g0[0] + g2[2])
    gz = w * (g1[0] - g0[1]) + x * (g0[2] + g2[0]) + y * (g1[2] + g2[1]) - two * z * (g0[0] + g1[1])
    along = gw * w + gx * x + gy * y + gz * z
    return h * (gw - along * w), h * (gx - along * x), h * (gy - along * y), h * (gz - along * z)


@kernel(part=True)
def conic_backward(u, v, eps2d, sxx, sxy, syy, thinning):
    """Conic A, B, C (the exponent is -1/2 (A xx + 2 B xy + C yy)), and the gradient xx, xy, yy of the covariance.

    With the conic Q and half the second moments M it is Q M Q. What the dilation takes of the density, with an
    antialiased s = ``thinning``, adds s (inv(S) - Q), S the covariance before the dilation.
    """
    uu, vv, uv = dot(u, u), dot(v, v), dot(u, v)
    # |u x v|^2, as in the forward pass
    normal = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
    det0 = dot(normal, normal)
    det = det0 + eps2d * (uu + vv + eps2d)
    det = det if det > f4(1e-20) else f4(1e-20)
    scale, scale0 = f4(1.0) / det, f4(1.0) / (det0 if det0 > f4(1e-30) else f4(1.0))
    a, b, c = (vv + eps2d) * scale, -uv * scale, (uu + eps2d) * scale
    thinning = thinning if det0 > f4(0.005 * 0.005) * det else f4(0.0)
    e00, e01, e10, e11 = a * sxx + b * sxy, a * sxy + b * syy, b * sxx + c * sxy, b * sxy + c * syy
    gxx = e00 * a + e01 * b + thinning * (vv * scale0 - a)
    gxy = e00 * b + e01 * c - thinning * (uv * scale0 + b)
    gyy = e10 * b + e11 * c + thinning * (uu * scale0 - c)
    return a, b, c, gxx, gxy, gyy


@kernel(part=True)
def block_backward(block, camera):
    """Replace the Gaussians of a block by their gradients."""
    r0, r1, r2 = (camera[0], camera[1], camera[2]), (camera[3], camera[4], camera[5]), (camera[6], camera[7], camera[8])
    t0, t1, t2 = camera[SHIFT], camera[SHIFT + 1], camera[SHIFT + 2]
    fx, fy, eps2d = camera[FX], camera[FY], camera[EPS2D]
    right, left, below, above = camera[LIMIT_X], camera[LIMIT_X + 1], camera[LIMIT_Y], camera[LIMIT_Y + 1]
    widest = MAX_SIGMA / (fx if fx > fy else fy)
    zero, half, one, two = f4(0.0), f4(0.5), f4(1.0), f4(2.0)
    filtered = camera[ANTIALIASED] * half
    for lane in range(BLOCK):
        i = np.uint64(lane)
        # what the forward pass computed: camera position, rows a, b of J W, rotation m, half axes u, v
        p = block[i + P[0]], block[i + P[1]], block[i + P[2]]
        x, y, z = dot(r0, p) + t0, dot(r1, p) + t1, dot(r2, p) + t2
        iz = one / z
        ux, uy, jx, jy = x * iz, y * iz, fx * iz, fy * iz
        tx, ty = _between(ux, left, right), _between(uy, above, below)
        jxz, jyz = -jx * tx, -jy * ty
        a, b = mix(jx, r0, jxz, r2), mix(jy, r1, jyz, r2)
        qw, qx, qy, qz = block[i + P[3]], block[i + P[4]], block[i + P[5]], block[i + P[6]]
        qq = qw * qw + qx * qx + qy * qy + qz * qz
        h, qn = two if qq > f4(1e-30) else zero, one / np.sqrt(qq if qq > f4(1e-30) else one)
        qw, qx, qy, qz = qw * qn, qx * qn, qy * qn, qz * qn
        m = rotation(qw, qx, qy, qz, h)
        s0, s1, s2, wide = block[i + P[7]], block[i + P[8]], block[i + P[9]], widest * z
        free = one if s0 < wide else zero, one if s1 < wide else zero, one if s2 < wide else zero
        s = s0 if s0 < wide else wide, s1 if s1 < wide else wide, s2 if s2 < wide else wide
        c, d = transposed(m, a), transposed(m, b)
        u, v = scaled(c, s), scaled(d, s)
        # covariance, half axes, and c, d through them
        sv, sx, sy = block[i + P[13]], block[i + P[14]], block[i + P[15]]
        sxx, sxy, syy = half * block[i + P[16]], half * block[i + P[17]], half * block[i + P[18]]
        ca, cb, cc, gxx, gxy, gyy = conic_backward(u, v, eps2d, sxx, sxy, syy, filtered * sv)
        gu, gv = mix(two * gxx, u, two * gxy, v), mix(two * gxy, u, two * gyy, v)
        gs = scaled((gu[0] * c[0] + gv[0] * d[0], gu[1] * c[1] + gv[1] * d[1], gu[2] * c[2] + gv[2] * d[2]), free)
        gc, gd = scaled(gu, s), scaled(gv, s)
        block[i + P[3]], block[i + P[4]], block[i + P[5]], block[i + P[6]] = rotation_backward(
            qw, qx, qy, qz, h * qn, a, gc, b, gd
        )
        block[i + P[7]], block[i + P[8]], block[i + P[9]] = gs
        # J W, and through it and the image position the camera position
        ga, gb = times(m, gc), times(m, gd)
        kxz, kyz = dot(ga, r2), dot(gb, r2)
        gux = fx * (ca * sx + cb * sy) - (jx * kxz if ux == tx else zero)
        guy = fy * (cb * sx + cc * sy) - (jy * kyz if uy == ty else zero)
        giz = fx * (dot(ga, r0) - tx * kxz) + fy * (dot(gb, r1) - ty * kyz) + gux * x + guy * y
        g = gux * iz, guy * iz, -iz * iz * giz
        block[i + P[0]], block[i + P[1]], block[i + P[2]] = transposed((r0, r1, r2), g)
        opacity = block[i + P[19]]
        block[i + P[19]] = sv / opacity if opacity <= one else zero
        block[i + P[20]], block[i + P[21]], block[i + P[22]] = mix(g[0], p, jx, ga)
        block[i + P[23]], block[i + P[24]], block[i + P[25]] = mix(g[1], p, jy, gb)
        block[i + P[26]], block[i + P[27]], block[i + P[28]] = mix(g[2], p, one, mix(jxz, ga, jyz, gb))
        block[i + P[29]], block[i + P[30]], block[i + P[31]] = g


@kernel
def project_backward(
    means, quats, scales, opacities, ids, sums, camera, first, last,
    grad_means, grad_quats, grad_scales, grad_opacities, grad_poses,
):  # fmt: skip
    """Gradients of a range of the listed Gaussians.

    Args:
        sums: ``[m,SUMS]`` float32, see :mod:`gsmerge.kernels.raster.blend_backward`.
        first: Start of the range, a multiple of BLOCK.
        last: End of the range, exclusive.
        grad_means: ``[m,3]`` float32, written.
        grad_quats: ``[m,4]`` float32, written.
        grad_scales: ``[m,3]`` float32, written.
        grad_opacities: ``[m]`` float32, written.
        grad_poses: ``[blocks,POSE]`` float32, written: gradient of the world-to-camera matrix, summed over blocks of
            BLOCK Gaussians; an empty array for none.
    """
    block = np.empty(PLANES * BLOCK, np.float32)
    for i in range(block.shape[0]):
        block[i] = f4(1.0)
    for start in range(first, last, BLOCK):
        size = min(BLOCK, last - start)
        for lane in range(size):
            k = np.uint64(start + lane)
            i = np.uint64(ids[k])
            j = np.uint64(lane)
            block[j], block[j + P[1]], block[j + P[2]] = means[i, 0], means[i, 1], means[i, 2]
            block[j + P[3]], block[j + P[4]] = quats[i, 0], quats[i, 1]
            block[j + P[5]], block[j + P[6]] = quats[i, 2], quats[i, 3]
            block[j + P[7]], block[j + P[8]], block[j + P[9]] = scales[i, 0], scales[i, 1], scales[i, 2]
            block[j + P[13]], block[j + P[14]], block[j + P[15]] = sums[k, 3], sums[k, 4], sums[k, 5]
            block[j + P[16]], block[j + P[17]], block[j + P[18]] = sums[k, 6], sums[k, 7], sums[k, 8]
            block[j + P[19]] = opacities[i]
        block_backward(block, camera)
        for lane in range(size):
            k = np.uint64(start + lane)
            j = np.uint64(lane)
            grad_means[k, 0], grad_means[k, 1], grad_means[k, 2] = block[j], block[j + P[1]], block[j + P[2]]
            grad_quats[k, 0], grad_quats[k, 1] = block[j + P[3]], block[j + P[4]]
            grad_quats[k, 2], grad_quats[k, 3] = block[j + P[5]], block[j + P[6]]
            grad_scales[k, 0], grad_scales[k, 1], grad_scales[k, 2] = block[j + P[7]], block[j + P[8]], block[j + P[9]]
            grad_opacities[k] = block[j + P[19]]
        if grad_poses.shape[0] > 0:
            for q in range(POSE):
                total = f4(0.0)
                for lane in range(size):
                    total += block[P[20] + np.uint64(q * BLOCK + lane)]
                grad_poses[start // BLOCK, q] = total


@kernel
def add_rows(ids, rows, totals):
    """Add ``rows [m,c]`` to ``totals [n,c]`` at the ``ids [m]`` int32."""
    for i in range(ids.shape[0]):
        k = np.uint64(ids[i])
        for c in range(rows.shape[1]):
            totals[k, c] += rows[i, c]
