"""Colours of Gaussians seen from a point: real spherical harmonics of degrees 0 to 4."""

from __future__ import annotations

import numpy as np
from numpy import float32 as f4

from gsmerge.kernels.jit import kernel


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
    """Colours of a range of the listed Gaussians as seen from ``eye``, not below 0.

    Args:
        means: ``[n,3]`` float32.
        sh0: ``[n,1,3]`` float32.
        shN: ``[n,k-1,3]`` float32.
        ids: ``[m]`` int32.
        eye: ``[3]`` float32.
        first: Start of the range.
        last: End of the range, exclusive.
        colors: ``[m,3]`` float32, written.
    """
    basis = np.zeros(25, np.float32)
    num = shN.shape[1]
    degree = 0
    while (degree + 1) * (degree + 1) < num + 1:
        degree += 1
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
