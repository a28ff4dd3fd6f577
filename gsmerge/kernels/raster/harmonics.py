"""Colours of Gaussians seen from a point, and their gradients: real spherical harmonics of degrees 0 to 4."""

from __future__ import annotations

import numpy as np
from numpy import float32 as f4

from gsmerge.kernels.jit import kernel


@kernel
def _degree(num):
    """Degree of that many harmonics, the constant one not counted."""
    degree = 0
    while (degree + 1) * (degree + 1) < num + 1:
        degree += 1
    return degree


@kernel
def _basis(x, y, z, degree, basis):
    """Real spherical harmonics of a unit direction (Sloan 2013, signs and order of the 3DGS layout)."""
    xx, yy, zz = x * x, y * y, z * z
    basis[0] = f4(0.28209479177387814)
    if degree > 0:
        basis[1] = f4(-0.4886025119029199) * y
        basis[2] = f4(0.4886025119029199) * z
        basis[3] = f4(-0.4886025119029199) * x
    if degree > 1:
        basis[4] = f4(1.0925484305920792) * x * y
        basis[5] = f4(-1.0925484305920792) * y * z
        basis[6] = f4(0.31539156525252005) * (f4(2.0) * zz - xx - yy)
        basis[7] = f4(-1.0925484305920792) * x * z
        basis[8] = f4(0.5462742152960396) * (xx - yy)
    if degree > 2:
        basis[9] = f4(-0.5900435899266435) * y * (f4(3.0) * xx - yy)
        basis[10] = f4(2.890611442640554) * x * y * z
        basis[11] = f4(-0.4570457994644658) * y * (f4(4.0) * zz - xx - yy)
        basis[12] = f4(0.3731763325901154) * z * (f4(2.0) * zz - f4(3.0) * xx - f4(3.0) * yy)
        basis[13] = f4(-0.4570457994644658) * x * (f4(4.0) * zz - xx - yy)
        basis[14] = f4(1.445305721320277) * z * (xx - yy)
        basis[15] = f4(-0.5900435899266435) * x * (xx - f4(3.0) * yy)
    if degree > 3:
        basis[16] = f4(2.5033429417967046) * x * y * (xx - yy)
        basis[17] = f4(-1.7701307697799304) * y * z * (f4(3.0) * xx - yy)
        basis[18] = f4(0.9461746957575601) * x * y * (f4(7.0) * zz - f4(1.0))
        basis[19] = f4(-0.6690465435572892) * y * z * (f4(7.0) * zz - f4(3.0))
        basis[20] = f4(0.10578554691520431) * (zz * (f4(35.0) * zz - f4(30.0)) + f4(3.0))
        basis[21] = f4(-0.6690465435572892) * x * z * (f4(7.0) * zz - f4(3.0))
        basis[22] = f4(0.47308734787878004) * (xx - yy) * (f4(7.0) * zz - f4(1.0))
        basis[23] = f4(-1.7701307697799304) * x * z * (xx - f4(3.0) * yy)
        basis[24] = f4(0.6258357354491761) * (xx * (xx - f4(3.0) * yy) - yy * (f4(3.0) * xx - yy))


@kernel
def view_colors(means, sh0, shN, ids, eye, first, last, colors):
    """Write the colours of a range of the listed Gaussians as seen from ``eye [3]``, not below 0."""
    basis = np.zeros(25, np.float32)
    num = shN.shape[1]
    degree = _degree(num)
    _basis(f4(0.0), f4(0.0), f4(1.0), 0, basis)
    for i in range(first, last):
        g = np.uint64(ids[i])
        red, green, blue = basis[0] * sh0[g, 0, 0], basis[0] * sh0[g, 0, 1], basis[0] * sh0[g, 0, 2]
        if degree > 0:
            x, y, z = means[g, 0] - eye[0], means[g, 1] - eye[1], means[g, 2] - eye[2]
            length = np.sqrt(x * x + y * y + z * z)
            scale = f4(1.0) / length if length > f4(0.0) else f4(0.0)
            _basis(x * scale, y * scale, z * scale, degree, basis)
            for k in range(num):
                b = basis[k + 1]
                red += b * shN[g, k, 0]
                green += b * shN[g, k, 1]
                blue += b * shN[g, k, 2]
        colors[i, 0] = max(f4(0.0), red + f4(0.5))
        colors[i, 1] = max(f4(0.0), green + f4(0.5))
        colors[i, 2] = max(f4(0.0), blue + f4(0.5))


@kernel
def _basis_slope(x, y, z, degree, w):
    """Gradient of the sum over k of ``w[k] basis[k]`` with respect to the unit direction."""
    two, three, four, six, seven = f4(2.0), f4(3.0), f4(4.0), f4(6.0), f4(7.0)
    c = f4(0.4886025119029199)
    gx, gy, gz = -c * w[3], -c * w[1], c * w[2]
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    if degree > 1:
        a, b, c = f4(1.0925484305920792), f4(0.31539156525252005) * w[6], f4(0.5462742152960396) * w[8]
        gx += a * (y * w[4] - z * w[7]) + two * x * (c - b)
        gy += a * (x * w[4] - z * w[5]) - two * y * (c + b)
        gz += four * z * b - a * (y * w[5] + x * w[7])
    if degree > 2:
        w9, w15 = f4(0.5900435899266435) * w[9], f4(0.5900435899266435) * w[15]
        w10, w14 = f4(2.890611442640554) * w[10], f4(1.445305721320277) * w[14]
        w11, w13 = f4(0.4570457994644658) * w[11], f4(0.4570457994644658) * w[13]
        w12 = f4(0.3731763325901154) * w[12]
        gx += yz * w10 + two * xy * (w11 - three * w9) - six * xz * w12 + two * xz * w14
        gx -= (four * zz - three * xx - yy) * w13 + three * (xx - yy) * w15
        gy += xz * w10 + two * xy * (w13 + three * w15) - six * yz * w12 - two * yz * w14
        gy -= (four * zz - xx - three * yy) * w11 + three * (xx - yy) * w9
        gz += xy * w10 - f4(8.0) * (yz * w11 + xz * w13) + three * (two * zz - xx - yy) * w12 + (xx - yy) * w14
    if degree > 3:
        w16, w17, w18 = f4(2.5033429417967046) * w[16], f4(1.7701307697799304) * w[17], f4(0.9461746957575601) * w[18]
        w19, w20, w21 = f4(0.6690465435572892) * w[19], f4(0.10578554691520431) * w[20], f4(0.6690465435572892) * w[21]
        w22, w23, w24 = f4(0.47308734787878004) * w[22], f4(1.7701307697799304) * w[23], f4(2.5033429417967046) * w[24]
        wide, tall, flat = three * xx - yy, xx - three * yy, xx - yy
        gx += y * wide * w16 - six * xy * z * w17 + (seven * zz - f4(1.0)) * (y * w18 + two * x * w22)
        gx += x * tall * w24 - z * (seven * zz - three) * w21 - three * z * flat * w23
        gy += x * tall * w16 + six * xy * z * w23 + (seven * zz - f4(1.0)) * (x * w18 - two * y * w22)
        gy -= z * (seven * zz - three) * w19 + three * z * flat * w17 + y * wide * w24
        gz += f4(14.0) * z * (xy * w18 + flat * w22) - y * wide * w17 - x * tall * w23
        gz += f4(20.0) * z * (seven * zz - three) * w20 - three * (seven * zz - f4(1.0)) * (y * w19 + x * w21)
    return gx, gy, gz


@kernel
def view_colors_backward(means, shN, ids, eye, first, last, colors, grad_colors, grad_sh0, grad_shN, grad_means):
    """Gradients of a range of the listed Gaussians through their colours seen from ``eye``.

    Args:
        colors: ``[m,3]`` float32, as seen; no gradient passes where they are 0.
        grad_colors: ``[m,3]`` float32.
        grad_sh0: ``[m,1,3]`` float32, written.
        grad_shN: ``[m,k-1,3]`` float32, written.
        grad_means: ``[m,3]`` float32, through the viewing direction alone, written.
    """
    basis, weights, zero = np.zeros(25, np.float32), np.zeros(25, np.float32), f4(0.0)
    num = shN.shape[1]
    degree = _degree(num)
    _basis(zero, zero, f4(1.0), 0, basis)
    for i in range(first, last):
        g = np.uint64(ids[i])
        red = grad_colors[i, 0] if colors[i, 0] > zero else zero
        green = grad_colors[i, 1] if colors[i, 1] > zero else zero
        blue = grad_colors[i, 2] if colors[i, 2] > zero else zero
        grad_sh0[i, 0, 0], grad_sh0[i, 0, 1], grad_sh0[i, 0, 2] = basis[0] * red, basis[0] * green, basis[0] * blue
        gx, gy, gz = zero, zero, zero
        if degree > 0:
            x, y, z = means[g, 0] - eye[0], means[g, 1] - eye[1], means[g, 2] - eye[2]
            length = np.sqrt(x * x + y * y + z * z)
            scale = f4(1.0) / length if length > zero else zero
            x, y, z = x * scale, y * scale, z * scale
            _basis(x, y, z, degree, basis)
            for k in range(num):
                b = basis[k + 1]
                grad_shN[i, k, 0], grad_shN[i, k, 1], grad_shN[i, k, 2] = b * red, b * green, b * blue
                weights[k + 1] = shN[g, k, 0] * red + shN[g, k, 1] * green + shN[g, k, 2] * blue
            gx, gy, gz = _basis_slope(x, y, z, degree, weights)
            # only what is across the direction moves it, the less the further away
            along = x * gx + y * gy + z * gz
            gx, gy, gz = (gx - along * x) * scale, (gy - along * y) * scale, (gz - along * z) * scale
        grad_means[i, 0], grad_means[i, 1], grad_means[i, 2] = gx, gy, gz
