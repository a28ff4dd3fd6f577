"""Projection of Gaussians into one view: culling, EWA footprints, tile boxes.

The conventions are those of gsplat: 0.3 px dilation, footprints from the first-order (EWA) projection with the
direction clamped 15 % outside the image, no contribution below 1/255. A footprint is stored with its square
completed, so that the exponent of a pixel is never positive, however thin the Gaussian::

    ln w(x, y) = lnop - (rate_x (x - mean_x - slope (y - mean_y)))^2 - rate_y (y - mean_y)^2

Every kernel works on blocks: members are gathered into planes of one flat buffer (a single base pointer needs no
run-time alias checks, so the arithmetic between gathering and scattering vectorises).
"""

from __future__ import annotations

import numpy as np
from numpy import float32 as f4

from gsmerge.kernels.jit import kernel

TILE = 16  # pixels per side; one row of a tile is one AVX-512 vector
FOOTPRINT = 8  # numbers per footprint: mean_x, mean_y, rate_x, slope, rate_y, lnop, first row, last row
LN_CUT = f4(np.log(1 / 255))  # ln of the smallest weight that is drawn
MIN_OPACITY = f4(1 / 255)

BLOCK = 256
P1, P2, P3, P4, P5, P6, P7, P8, P9, P10 = (np.uint64(BLOCK * plane) for plane in range(1, 11))

# Positions in the camera's array of numbers.
ROTATION, SHIFT, FX, FY, CX, CY, WIDTH, HEIGHT, NEAR, FAR, EPS2D = 0, 9, 12, 13, 14, 15, 16, 17, 18, 19, 20
LIMIT_X, LIMIT_Y, ANTIALIASED = 21, 23, 25
CAMERA = 26

MAX_SIGMA = f4(1e6)  # pixels; a wider footprint is flat over any image, and its square still fits float32


@kernel
def _between(value, low, high):
    """Clamp, in a form that vectorises."""
    value = value if value < high else high
    return value if value > low else low


@kernel(part=True)
def cull_block(block, camera):
    """Replace plane 0 by 1 where a bounding sphere may touch the image, else 0; 1 to 4 by the box that it may touch.

    Planes in: mean x, y, z, scales x, y, z, opacity. The box: first and last column, first and last row, pixels.
    """
    r00, r01, r02 = camera[0], camera[1], camera[2]
    r10, r11, r12 = camera[3], camera[4], camera[5]
    r20, r21, r22 = camera[6], camera[7], camera[8]
    t0, t1, t2 = camera[SHIFT], camera[SHIFT + 1], camera[SHIFT + 2]
    fx, fy, cx, cy, width, height = camera[FX], camera[FY], camera[CX], camera[CY], camera[WIDTH], camera[HEIGHT]
    near, far, eps2d = camera[NEAR], camera[FAR], camera[EPS2D]
    right, left, below, above = camera[LIMIT_X], camera[LIMIT_X + 1], camera[LIMIT_Y], camera[LIMIT_Y + 1]
    reach = f4(-2.0) * LN_CUT
    for lane in range(BLOCK):
        i = np.uint64(lane)
        px, py, pz = block[i], block[i + P1], block[i + P2]
        s0, s1, s2 = block[i + P3], block[i + P4], block[i + P5]
        s = s0 if s0 > s1 else s1
        s = s if s > s2 else s2
        z = r20 * px + r21 * py + r22 * pz + t2
        iz = f4(1.0) / z
        ux = (r00 * px + r01 * py + r02 * pz + t0) * iz
        uy = (r10 * px + r11 * py + r12 * pz + t1) * iz
        tx, ty = _between(ux, left, right), _between(uy, above, below)
        jx, jy = fx * iz, fy * iz
        rx = np.sqrt(reach * (s * s * jx * jx * (f4(1.0) + tx * tx) + eps2d))
        ry = np.sqrt(reach * (s * s * jy * jy * (f4(1.0) + ty * ty) + eps2d))
        mx, my = fx * ux + cx, fy * uy + cy
        inside = f4(1.0) if z > near else f4(0.0)
        inside = inside if z < far else f4(0.0)
        inside = inside if block[i + P6] >= MIN_OPACITY else f4(0.0)
        inside = inside if mx + rx > f4(0.0) else f4(0.0)
        inside = inside if mx - rx < width else f4(0.0)
        inside = inside if my + ry > f4(0.0) else f4(0.0)
        inside = inside if my - ry < height else f4(0.0)
        block[i] = inside
        block[i + P1], block[i + P2] = _between(mx - rx, f4(0.0), width), _between(mx + rx, f4(0.0), width)
        block[i + P3], block[i + P4] = _between(my - ry, f4(0.0), height), _between(my + ry, f4(0.0), height)


@kernel(part=True)
def touches(block, lane, wanted):
    """Return whether the box of a Gaussian contains one of the tiles that are ``wanted``, see :func:`cull`."""
    j = np.uint64(lane)
    last_x, last_y = wanted.shape[1] - 1, wanted.shape[0] - 1
    x0, x1 = int(block[j + P1]) // TILE, min(int(block[j + P2]) // TILE + 1, last_x)
    y0, y1 = int(block[j + P3]) // TILE, min(int(block[j + P4]) // TILE + 1, last_y)
    x0, y0 = min(x0, last_x), min(y0, last_y)
    return wanted[y1, x1] - wanted[y0, x1] - wanted[y1, x0] + wanted[y0, x0] > 0


@kernel
def cull(means, scales, opacities, keep, wanted, camera, first, last, ids):
    """List the Gaussians of a range that may touch the image -> their number.

    Args:
        keep: ``[n]`` uint8, 0 drops a Gaussian; an empty array keeps all.
        wanted: ``[lines + 1, columns + 1]`` int32: the number of tiles above and left of each corner that a Gaussian
            has to touch one of; an empty array wants all.
        ids: ``[last - first + 1]`` int32, written: ascending.
    """
    block = np.zeros(7 * BLOCK, np.float32)
    count = 0
    all_kept, all_wanted = keep.shape[0] == 0, wanted.shape[0] == 0
    for start in range(first, last, BLOCK):
        size = min(BLOCK, last - start)
        for lane in range(size):
            i = np.uint64(start + lane)
            j = np.uint64(lane)
            block[j], block[j + P1], block[j + P2] = means[i, 0], means[i, 1], means[i, 2]
            block[j + P3], block[j + P4], block[j + P5] = scales[i, 0], scales[i, 1], scales[i, 2]
            block[j + P6] = opacities[i]
        cull_block(block, camera)
        for lane in range(size):
            ids[count] = start + lane
            kept = all_kept or keep[start + lane] != 0
            kept = kept and (block[lane] > f4(0.0)) and (all_wanted or touches(block, lane, wanted))
            count += 1 if kept else 0
    return count


@kernel(part=True)
def axes_block(block, camera):
    """Project positions and half axes of a block, in place.

    Planes in: mean x, y, z, quaternion w, x, y, z, scales x, y, z.
    Planes out: mean_x, mean_y, depth, u (3 planes), v (3 planes): rows of J W R S, the half axes seen in the image.
    """
    r00, r01, r02 = camera[0], camera[1], camera[2]
    r10, r11, r12 = camera[3], camera[4], camera[5]
    r20, r21, r22 = camera[6], camera[7], camera[8]
    t0, t1, t2 = camera[SHIFT], camera[SHIFT + 1], camera[SHIFT + 2]
    fx, fy, cx, cy = camera[FX], camera[FY], camera[CX], camera[CY]
    right, left, below, above = camera[LIMIT_X], camera[LIMIT_X + 1], camera[LIMIT_Y], camera[LIMIT_Y + 1]
    widest = MAX_SIGMA / (fx if fx > fy else fy)
    one, two = f4(1.0), f4(2.0)
    for lane in range(BLOCK):
        i = np.uint64(lane)
        px, py, pz = block[i], block[i + P1], block[i + P2]
        z = r20 * px + r21 * py + r22 * pz + t2
        iz = one / z
        ux = (r00 * px + r01 * py + r02 * pz + t0) * iz
        uy = (r10 * px + r11 * py + r12 * pz + t1) * iz
        # J W: the projection's derivative, with the direction clamped near the image
        jx, jy = fx * iz, fy * iz
        jxz, jyz = -jx * _between(ux, left, right), -jy * _between(uy, above, below)
        a0, a1, a2 = jx * r00 + jxz * r20, jx * r01 + jxz * r21, jx * r02 + jxz * r22
        b0, b1, b2 = jy * r10 + jyz * r20, jy * r11 + jyz * r21, jy * r12 + jyz * r22
        # 2 / |q|^2 normalises the quaternion; a zero one counts as no rotation
        qw, qx, qy, qz = block[i + P3], block[i + P4], block[i + P5], block[i + P6]
        qq = qw * qw + qx * qx + qy * qy + qz * qz
        h = two / qq if qq > f4(1e-30) else f4(0.0)
        m00, m01, m02 = one - h * (qy * qy + qz * qz), h * (qx * qy - qw * qz), h * (qx * qz + qw * qy)
        m10, m11, m12 = h * (qx * qy + qw * qz), one - h * (qx * qx + qz * qz), h * (qy * qz - qw * qx)
        m20, m21, m22 = h * (qx * qz - qw * qy), h * (qy * qz + qw * qx), one - h * (qx * qx + qy * qy)
        s0, s1, s2 = block[i + P7], block[i + P8], block[i + P9]
        wide = widest * z
        s0 = s0 if s0 < wide else wide
        s1 = s1 if s1 < wide else wide
        s2 = s2 if s2 < wide else wide
        block[i], block[i + P1], block[i + P2] = fx * ux + cx, fy * uy + cy, z
        block[i + P3] = (a0 * m00 + a1 * m10 + a2 * m20) * s0
        block[i + P4] = (a0 * m01 + a1 * m11 + a2 * m21) * s1
        block[i + P5] = (a0 * m02 + a1 * m12 + a2 * m22) * s2
        block[i + P6] = (b0 * m00 + b1 * m10 + b2 * m20) * s0
        block[i + P7] = (b0 * m01 + b1 * m11 + b2 * m21) * s1
        block[i + P8] = (b0 * m02 + b1 * m12 + b2 * m22) * s2


@kernel(part=True)
def footprint_block(block, eps2d):
    """Footprints of a block from its half axes, in place.

    Planes in: those of :func:`axes_block`. Planes out: mean_x, mean_y, depth (as they were), rate_x, slope, rate_y,
    variance x, variance y, share of the density that the dilation leaves (squared).
    """
    for lane in range(BLOCK):
        i = np.uint64(lane)
        u0, u1, u2 = block[i + P3], block[i + P4], block[i + P5]
        v0, v1, v2 = block[i + P6], block[i + P7], block[i + P8]
        uu, vv, uv = u0 * u0 + u1 * u1 + u2 * u2, v0 * v0 + v1 * v1 + v2 * v2, u0 * v0 + u1 * v1 + u2 * v2
        # |u x v|^2 = |u|^2 |v|^2 - (u.v)^2 without its cancellation: thin footprints keep a positive determinant
        n0, n1, n2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        det0 = n0 * n0 + n1 * n1 + n2 * n2
        det = det0 + eps2d * (uu + vv + eps2d)
        det = det if det > f4(1e-20) else f4(1e-20)
        cyy = vv + eps2d
        cyy = cyy if cyy > f4(1e-10) else f4(1e-10)
        iy = f4(1.0) / cyy
        block[i + P3] = np.sqrt(f4(0.5) * cyy / det)
        block[i + P4] = uv * iy
        block[i + P5] = f4(0.5) * iy
        block[i + P6], block[i + P7] = uu + eps2d, cyy
        block[i + P8] = det0 / det


@kernel(part=True)
def box_block(block, width, height):
    """Pixel ranges of a block where a weight may reach 1/255, in place.

    Planes in: those of :func:`footprint_block`, ln opacity in plane 10. Planes out: 6 to 9 first column, last
    column, first row, last row; an empty range has its last below its first.
    """
    half, one, zero = f4(0.5), f4(1.0), f4(0.0)
    for lane in range(BLOCK):
        i = np.uint64(lane)
        reach = f4(2.0) * (block[i + P10] - LN_CUT)
        reach = reach if reach > zero else zero
        mx, my = block[i], block[i + P1]
        rx, ry = np.sqrt(reach * block[i + P6]), np.sqrt(reach * block[i + P7])
        x0, x1 = np.ceil(mx - rx - half), np.floor(mx + rx - half)
        y0, y1 = np.ceil(my - ry - half), np.floor(my + ry - half)
        block[i + P6], block[i + P8] = x0 if x0 > zero else zero, y0 if y0 > zero else zero
        block[i + P7], block[i + P9] = (
            x1 if x1 < width - one else width - one,
            y1 if y1 < height - one else height - one,
        )


@kernel(part=True)
def store_block(block, start, size, footprints, depths, boxes):
    """Write a block's footprints, depths and tile boxes."""
    for lane in range(size):
        j = np.uint64(lane)
        k = np.uint64(start + lane)
        x0, x1, y0, y1 = block[j + P6], block[j + P7], block[j + P8], block[j + P9]
        footprints[k, 0], footprints[k, 1] = block[j], block[j + P1]
        footprints[k, 2], footprints[k, 3], footprints[k, 4] = block[j + P3], block[j + P4], block[j + P5]
        footprints[k, 5], footprints[k, 6], footprints[k, 7] = block[j + P10], y0, y1
        depths[k] = block[j + P2]
        drawn = (x1 >= x0) & (y1 >= y0) & (block[j + P10] >= LN_CUT)
        boxes[k, 0] = int(x0) // TILE if drawn else 0
        boxes[k, 1] = int(x1) // TILE + 1 if drawn else 0
        boxes[k, 2] = int(y0) // TILE if drawn else 0
        boxes[k, 3] = int(y1) // TILE + 1 if drawn else 0


@kernel
def project(means, quats, scales, lnops, ids, camera, footprints, depths, boxes):
    """Project the listed Gaussians.

    Args:
        quats: ``[n,4]`` wxyz; normalised here.
        lnops: ``[m]`` ln of the opacities of the listed ones.
        footprints: ``[m,FOOTPRINT]`` float32, written.
        depths: ``[m]`` float32, written: camera z.
        boxes: ``[m,4]`` int16, written: first and (exclusive) last tile column, first and last tile row; all 0
            where nothing is drawn.
    """
    block = np.empty(11 * BLOCK, np.float32)
    for i in range(block.shape[0]):
        block[i] = f4(1.0)
    antialiased = camera[ANTIALIASED] > f4(0.0)
    for start in range(0, ids.shape[0], BLOCK):
        size = min(BLOCK, ids.shape[0] - start)
        for lane in range(size):
            i = np.uint64(ids[start + lane])
            j = np.uint64(lane)
            block[j], block[j + P1], block[j + P2] = means[i, 0], means[i, 1], means[i, 2]
            block[j + P3], block[j + P4] = quats[i, 0], quats[i, 1]
            block[j + P5], block[j + P6] = quats[i, 2], quats[i, 3]
            block[j + P7], block[j + P8], block[j + P9] = scales[i, 0], scales[i, 1], scales[i, 2]
            block[j + P10] = lnops[start + lane]
        axes_block(block, camera)
        footprint_block(block, camera[EPS2D])
        if antialiased:
            for lane in range(size):
                block[lane + P10] += f4(0.5) * np.log(max(block[lane + P8], f4(0.005 * 0.005)))
        box_block(block, camera[WIDTH], camera[HEIGHT])
        store_block(block, start, size, footprints, depths, boxes)
