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
        turned = qq > f4(1e-30)
        qn = one / np.sqrt(qq if turned else one)
        qw, qx, qy, qz = qw * qn, qx * qn, qy * qn, qz * qn
        h = two if turned else zero
        m00, m01, m02 = one - h * (qy * qy + qz * qz), h * (qx * qy - qw * qz), h * (qx * qz + qw * qy)
        m10, m11, m12 = h * (qx * qy + qw * qz), one - h * (qx * qx + qz * qz), h * (qy * qz - qw * qx)
        m20, m21, m22 = h * (qx * qz - qw * qy), h * (qy * qz + qw * qx), one - h * (qx * qx + qy * qy)
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
        det = det0 + eps2d * (uu + vv + eps2d)
        det = det if det > f4(1e-20) else f4(1e-20)
        idet = one / det
        # the conic: the exponent is -1/2 (A xx + 2 B xy + C yy)
        ca, cb, cc = (vv + eps2d) * idet, -uv * idet, (uu + eps2d) * idet
        # covariance: d/dS = 1/2 Q M Q, Q the conic, M the second moments; the dilation's loss of density adds
        # 1/2 s (inv(S0) - Q), S0 the covariance before it
        sv, sx, sy = block[i + P[13]], block[i + P[14]], block[i + P[15]]
        sxx, sxy, syy = half * block[i + P[16]], half * block[i + P[17]], half * block[i + P[18]]
        e00, e01 = ca * sxx + cb * sxy, ca * sxy + cb * syy
        e10, e11 = cb * sxx + cc * sxy, cb * sxy + cc * syy
        thinned = filtered * sv if det0 > f4(0.005 * 0.005) * det else zero
        idet0 = one / (det0 if det0 > f4(1e-30) else one)
        g00 = e00 * ca + e01 * cb + thinned * (vv * idet0 - ca)
        g01 = e00 * cb + e01 * cc + thinned * (-uv * idet0 - cb)
        g11 = e10 * cb + e11 * cc + thinned * (uu * idet0 - cc)
        # half axes, scales, then c and d in place of u and v
        gu0, gu1, gu2 = two * (g00 * u0 + g01 * v0), two * (g00 * u1 + g01 * v1), two * (g00 * u2 + g01 * v2)
        gv0, gv1, gv2 = two * (g11 * v0 + g01 * u0), two * (g11 * v1 + g01 * u1), two * (g11 * v2 + g01 * u2)
        block[i + P[7]] = (gu0 * c0 + gv0 * d0) * free0
        block[i + P[8]] = (gu1 * c1 + gv1 * d1) * free1
        block[i + P[9]] = (gu2 * c2 + gv2 * d2) * free2
        gu0, gu1, gu2, gv0, gv1, gv2 = gu0 * s0, gu1 * s1, gu2 * s2, gv0 * s0, gv1 * s1, gv2 * s2
        # rotation, and through it the quaternion: only what is across it remains
        w00, w01, w02 = a0 * gu0 + b0 * gv0, a0 * gu1 + b0 * gv1, a0 * gu2 + b0 * gv2
        w10, w11, w12 = a1 * gu0 + b1 * gv0, a1 * gu1 + b1 * gv1, a1 * gu2 + b1 * gv2
        w20, w21, w22 = a2 * gu0 + b2 * gv0, a2 * gu1 + b2 * gv1, a2 * gu2 + b2 * gv2
        h0 = qx * (w21 - w12) + qy * (w02 - w20) + qz * (w10 - w01)
        h1 = qw * (w21 - w12) + qy * (w01 + w10) + qz * (w02 + w20) - two * qx * (w11 + w22)
        h2 = qw * (w02 - w20) + qx * (w01 + w10) + qz * (w12 + w21) - two * qy * (w00 + w22)
        h3 = qw * (w10 - w01) + qx * (w02 + w20) + qy * (w12 + w21) - two * qz * (w00 + w11)
        along, h = h0 * qw + h1 * qx + h2 * qy + h3 * qz, h * qn
        block[i + P[3]], block[i + P[4]] = h * (h0 - along * qw), h * (h1 - along * qx)
        block[i + P[5]], block[i + P[6]] = h * (h2 - along * qy), h * (h3 - along * qz)
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
