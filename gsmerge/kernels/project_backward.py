"""The backward pass of projection: from sums over an image to means, rotations, scales and opacities.

The chain of :mod:`gsmerge.kernels.project` backwards (EWA: Zwicker et al. 2001; the derivatives as in Ye et al.,
"Mathematical supplement for the gsplat library", 2023): footprint, half axes, rotation and scale, and the mean
through its image position and through the projection's derivative. Works on blocks like the forward pass.
"""

from __future__ import annotations

import numpy as np
from numpy import float32 as f4

from gsmerge.kernels.jit import kernel
from gsmerge.kernels.project import (
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


@kernel(inline=True)
def _rotation(w, x, y, z, h):
    """Rotation matrix of a unit quaternion, row by row; h is 2, or 0 for no rotation."""
    one = f4(1.0)
    return (
        one - h * (y * y + z * z), h * (x * y - w * z), h * (x * z + w * y),
        h * (x * y + w * z), one - h * (x * x + z * z), h * (y * z - w * x),
        h * (x * z - w * y), h * (y * z + w * x), one - h * (x * x + y * y),
    )  # fmt: skip


@kernel(inline=True)
def _rotation_backward(w, x, y, z, h, g00, g01, g02, g10, g11, g12, g20, g21, g22):
    """Gradient of the unit quaternion from that of its rotation matrix: only what is across it."""
    two = f4(2.0)
    gw = x * (g21 - g12) + y * (g02 - g20) + z * (g10 - g01)
    gx = w * (g21 - g12) + y * (g01 + g10) + z * (g02 + g20) - two * x * (g11 + g22)
    gy = w * (g02 - g20) + x * (g01 + g10) + z * (g12 + g21) - two * y * (g00 + g22)
    gz = w * (g10 - g01) + x * (g02 + g20) + y * (g12 + g21) - two * z * (g00 + g11)
    along = gw * w + gx * x + gy * y + gz * z
    return h * (gw - along * w), h * (gx - along * x), h * (gy - along * y), h * (gz - along * z)


@kernel(inline=True)
def _conic_backward(uu, uv, vv, det0, eps2d, sxx, sxy, syy, thinning):
    """Conic A, B, C (the exponent is -1/2 (A xx + 2 B xy + C yy)), and the gradient xx, xy, yy of the covariance.

    With the conic Q and half the second moments M it is Q M Q. What the dilation takes of the density, with an
    antialiased s = ``thinning``, adds s (inv(S) - Q), S the covariance before the dilation.
    """
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


@kernel
def _block_backward(block, camera):
    """Replace the Gaussians of a block by their gradients."""
    r00, r01, r02 = camera[0], camera[1], camera[2]
    r10, r11, r12 = camera[3], camera[4], camera[5]
    r20, r21, r22 = camera[6], camera[7], camera[8]
    t0, t1, t2 = camera[SHIFT], camera[SHIFT + 1], camera[SHIFT + 2]
    fx, fy, eps2d = camera[FX], camera[FY], camera[EPS2D]
    right, left, below, above = camera[LIMIT_X], camera[LIMIT_X + 1], camera[LIMIT_Y], camera[LIMIT_Y + 1]
    widest = MAX_SIGMA / (fx if fx > fy else fy)
    zero, half, one, two = f4(0.0), f4(0.5), f4(1.0), f4(2.0)
    filtered = camera[ANTIALIASED] * half
    for lane in range(BLOCK):
        i = np.uint64(lane)
        # what the forward pass computed: camera position, rows a, b of J W, rotation m, half axes u, v
        px, py, pz = block[i + P[0]], block[i + P[1]], block[i + P[2]]
        z = r20 * px + r21 * py + r22 * pz + t2
        x, y = r00 * px + r01 * py + r02 * pz + t0, r10 * px + r11 * py + r12 * pz + t1
        iz = one / z
        ux, uy = x * iz, y * iz
        tx, ty = _between(ux, left, right), _between(uy, above, below)
        jx, jy = fx * iz, fy * iz
        jxz, jyz = -jx * tx, -jy * ty
        a0, a1, a2 = jx * r00 + jxz * r20, jx * r01 + jxz * r21, jx * r02 + jxz * r22
        b0, b1, b2 = jy * r10 + jyz * r20, jy * r11 + jyz * r21, jy * r12 + jyz * r22
        qw, qx, qy, qz = block[i + P[3]], block[i + P[4]], block[i + P[5]], block[i + P[6]]
        qq = qw * qw + qx * qx + qy * qy + qz * qz
        h, qn = two if qq > f4(1e-30) else zero, one / np.sqrt(qq if qq > f4(1e-30) else one)
        qw, qx, qy, qz = qw * qn, qx * qn, qy * qn, qz * qn
        m00, m01, m02, m10, m11, m12, m20, m21, m22 = _rotation(qw, qx, qy, qz, h)
        s0, s1, s2 = block[i + P[7]], block[i + P[8]], block[i + P[9]]
        wide = widest * z
        free0, free1, free2 = one if s0 < wide else zero, one if s1 < wide else zero, one if s2 < wide else zero
        s0, s1, s2 = s0 if s0 < wide else wide, s1 if s1 < wide else wide, s2 if s2 < wide else wide
        c0, c1, c2 = a0 * m00 + a1 * m10 + a2 * m20, a0 * m01 + a1 * m11 + a2 * m21, a0 * m02 + a1 * m12 + a2 * m22
        d0, d1, d2 = b0 * m00 + b1 * m10 + b2 * m20, b0 * m01 + b1 * m11 + b2 * m21, b0 * m02 + b1 * m12 + b2 * m22
        u0, u1, u2 = c0 * s0, c1 * s1, c2 * s2
        v0, v1, v2 = d0 * s0, d1 * s1, d2 * s2
        uu, vv, uv = u0 * u0 + u1 * u1 + u2 * u2, v0 * v0 + v1 * v1 + v2 * v2, u0 * v0 + u1 * v1 + u2 * v2
        n0, n1, n2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        det0 = n0 * n0 + n1 * n1 + n2 * n2
        sv, sx, sy = block[i + P[13]], block[i + P[14]], block[i + P[15]]
        sxx, sxy, syy = half * block[i + P[16]], half * block[i + P[17]], half * block[i + P[18]]
        ca, cb, cc, gxx, gxy, gyy = _conic_backward(uu, uv, vv, det0, eps2d, sxx, sxy, syy, filtered * sv)
        # half axes, scales, then c and d in place of u and v
        gu0, gu1, gu2 = two * (gxx * u0 + gxy * v0), two * (gxx * u1 + gxy * v1), two * (gxx * u2 + gxy * v2)
        gv0, gv1, gv2 = two * (gyy * v0 + gxy * u0), two * (gyy * v1 + gxy * u1), two * (gyy * v2 + gxy * u2)
        block[i + P[7]] = (gu0 * c0 + gv0 * d0) * free0
        block[i + P[8]] = (gu1 * c1 + gv1 * d1) * free1
        block[i + P[9]] = (gu2 * c2 + gv2 * d2) * free2
        gu0, gu1, gu2, gv0, gv1, gv2 = gu0 * s0, gu1 * s1, gu2 * s2, gv0 * s0, gv1 * s1, gv2 * s2
        # rotation, and through it the quaternion: only what is across it remains
        w00, w01, w02 = a0 * gu0 + b0 * gv0, a0 * gu1 + b0 * gv1, a0 * gu2 + b0 * gv2
        w10, w11, w12 = a1 * gu0 + b1 * gv0, a1 * gu1 + b1 * gv1, a1 * gu2 + b1 * gv2
        w20, w21, w22 = a2 * gu0 + b2 * gv0, a2 * gu1 + b2 * gv1, a2 * gu2 + b2 * gv2
        block[i + P[3]], block[i + P[4]], block[i + P[5]], block[i + P[6]] = _rotation_backward(
            qw, qx, qy, qz, h * qn, w00, w01, w02, w10, w11, w12, w20, w21, w22
        )
        # J W, and through it and the image position the camera position
        ga0, ga1, ga2 = (
            m00 * gu0 + m01 * gu1 + m02 * gu2,
            m10 * gu0 + m11 * gu1 + m12 * gu2,
            m20 * gu0 + m21 * gu1 + m22 * gu2,
        )
        gb0, gb1, gb2 = (
            m00 * gv0 + m01 * gv1 + m02 * gv2,
            m10 * gv0 + m11 * gv1 + m12 * gv2,
            m20 * gv0 + m21 * gv1 + m22 * gv2,
        )
        kx, kxz = ga0 * r00 + ga1 * r01 + ga2 * r02, ga0 * r20 + ga1 * r21 + ga2 * r22
        ky, kyz = gb0 * r10 + gb1 * r11 + gb2 * r12, gb0 * r20 + gb1 * r21 + gb2 * r22
        gux, guy = fx * (ca * sx + cb * sy), fy * (cb * sx + cc * sy)
        gux -= jx * kxz if ux == tx else zero
        guy -= jy * kyz if uy == ty else zero
        giz = fx * (kx - tx * kxz) + fy * (ky - ty * kyz) + gux * x + guy * y
        gx, gy, gz = gux * iz, guy * iz, -iz * iz * giz
        block[i + P[0]] = r00 * gx + r10 * gy + r20 * gz
        block[i + P[1]] = r01 * gx + r11 * gy + r21 * gz
        block[i + P[2]] = r02 * gx + r12 * gy + r22 * gz
        opacity = block[i + P[19]]
        block[i + P[19]] = sv / opacity if opacity <= one else zero
        block[i + P[20]], block[i + P[21]], block[i + P[22]] = (
            gx * px + jx * ga0,
            gx * py + jx * ga1,
            gx * pz + jx * ga2,
        )
        block[i + P[23]], block[i + P[24]], block[i + P[25]] = (
            gy * px + jy * gb0,
            gy * py + jy * gb1,
            gy * pz + jy * gb2,
        )
        block[i + P[26]] = gz * px + jxz * ga0 + jyz * gb0
        block[i + P[27]] = gz * py + jxz * ga1 + jyz * gb1
        block[i + P[28]] = gz * pz + jxz * ga2 + jyz * gb2
        block[i + P[29]], block[i + P[30]], block[i + P[31]] = gx, gy, gz


@kernel
def project_backward(
    means, quats, scales, opacities, ids, sums, camera, first, last,
    grad_means, grad_quats, grad_scales, grad_opacities, grad_poses,
):  # fmt: skip
    """Gradients of a range of the listed Gaussians.

    Args:
        means: ``[n,3]``.
        quats: ``[n,4]`` wxyz, of any length above 0.
        scales: ``[n,3]``.
        opacities: ``[n]``.
        ids: ``[m]`` int32.
        sums: ``[m,SUMS]`` float32, see :mod:`gsmerge.kernels.raster_backward`.
        camera: ``[CAMERA]`` float32.
        first: Start of the range, a multiple of BLOCK.
        last: End of the range, exclusive.
        grad_means: ``[m,3]`` float32, written.
        grad_quats: ``[m,4]`` float32, written.
        grad_scales: ``[m,3]`` float32, written.
        grad_opacities: ``[m]`` float32, written.
        grad_poses: ``[blocks,POSE]`` float32, written: gradient of the world-to-camera matrix, summed over blocks of
            BLOCK Gaussians; an empty array for none.
    """
    block = np.ones(PLANES * BLOCK, np.float32)
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
        _block_backward(block, camera)
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
