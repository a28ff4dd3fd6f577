"""The gradient of the fit's image loss in one pass over the rows: no image is written but the result.

Structural similarity needs sums over windows of image, photo and their products, and then sums over windows of what
those give. Rows of sums are kept in rings of as many rows as a window has, so a pass needs the cache alone. Every sum
is added up in the same order wherever a range of rows begins, so results do not depend on how rows are shared out.
"""

from __future__ import annotations

import numpy as np
from numpy import float32 as f4

from gsmerge.kernels.jit import kernel

RADIUS = 3  # of the windows, pixels
SIDE = 2 * RADIUS + 1
PAD = 3 * RADIUS  # values beside a row of three channels
MEANS, TERMS = 5, 3  # sums over windows: of x, y, x², y², xy; of the derivatives with respect to three of their means
C1, C2 = f4(1e-4), f4(9e-4)  # SSIM's constants for a data range of 1
SHARE = f4(1 / (SIDE * SIDE))


@kernel(part=True)
def sum_rows(padded, rings, slot):
    """Sums over the seven values about each one of padded rows, of every channel apart."""
    for q in range(padded.shape[0]):
        row, out = padded[q], rings[q, slot]
        for i in range(out.shape[0]):
            out[i] = row[i] + row[i + 3] + row[i + 6] + row[i + 9] + row[i + 12] + row[i + 15] + row[i + 18]


@kernel(part=True)
def sum_columns(rings, slot, sums):
    """Sum over the seven rows of rings, the newest of which is in ``slot``."""
    for q in range(rings.shape[0]):
        ring, out = rings[q], sums[q]
        a, b, c, d = ring[(slot + 1) % SIDE], ring[(slot + 2) % SIDE], ring[(slot + 3) % SIDE], ring[(slot + 4) % SIDE]
        e, f, g = ring[(slot + 5) % SIDE], ring[(slot + 6) % SIDE], ring[slot]
        for i in range(out.shape[0]):
            out[i] = a[i] + b[i] + c[i] + d[i] + e[i] + f[i] + g[i]


@kernel(part=True)
def write_products(x, y, padded):
    p0, p1, p2, p3, p4 = padded[0], padded[1], padded[2], padded[3], padded[4]
    for i in range(x.shape[0]):
        a, b = x[i], y[i]
        p0[PAD + i], p1[PAD + i] = a, b
        p2[PAD + i], p3[PAD + i], p4[PAD + i] = a * a, b * b, a * b


@kernel(part=True)
def write_terms(sums, weight, padded):
    """Derivatives of a row of windows' SSIM by the means of x, x² and xy, times the weights of their pixels."""
    s0, s1, s2, s3, s4 = sums[0], sums[1], sums[2], sums[3], sums[4]
    p0, p1, p2 = padded[0], padded[1], padded[2]
    for i in range(s0.shape[0]):
        a, b = SHARE * s0[i], SHARE * s1[i]
        n1, n2 = f4(2.0) * a * b + C1, f4(2.0) * (SHARE * s4[i] - a * b) + C2
        d1, d2 = a * a + b * b + C1, SHARE * (s2[i] + s3[i]) - a * a - b * b + C2
        q = f4(1.0) / (d1 * d2)
        ssim, w = n1 * n2 * q, SHARE * weight[i]
        square, cross = -ssim * d1 * q, f4(2.0) * n1 * q
        p0[PAD + i] = w * (f4(2.0) * (b * n2 - a * ssim * d2) * q - f4(2.0) * a * square - b * cross)
        p1[PAD + i], p2[PAD + i] = w * square, w * cross


@kernel(part=True)
def write_gradient(sums, x, y, weight, plain, similar, gradient):
    """The gradient of a row, and its weighted squared error."""
    s0, s1, s2, squares = sums[0], sums[1], sums[2], f4(0.0)
    for i in range(x.shape[0]):
        difference = x[i] - y[i]
        sign = np.copysign(f4(1.0), difference) if difference != f4(0.0) else f4(0.0)
        gradient[i] = plain * weight[i] * sign - similar * (s0[i] + f4(2.0) * s1[i] * x[i] + s2[i] * y[i])
        squares += weight[i] * difference * difference
    return squares


@kernel(part=True)
def repeat(weight, wide):
    for i in range(weight.shape[0]):
        wide[3 * i] = wide[3 * i + 1] = wide[3 * i + 2] = weight[i]


@kernel
def image_gradient(image, photo, weight, ssim_lambda, first, last, gradient, errors):
    """Gradient of (1 - ssim_lambda) |image - photo| + ssim_lambda (1 - SSIM), each pixel with its weight.

    Windows of SSIM are uniform, of 7 x 7 pixels, zero beyond the border.

    Args:
        image: ``[h,3w]`` float32, interleaved channels.
        photo: ``[h,3w]`` float32.
        weight: ``[h,w]`` float32.
        ssim_lambda: Share of structural similarity, float32.
        first: First row.
        last: Last row, exclusive.
        gradient: ``[h,3w]`` float32, the rows are written, divided by the number of pixels.
        errors: ``[h]`` float32, weighted squared error of each row, written.
    """
    height, width = image.shape
    rings, term_rings = np.zeros((MEANS, SIDE, width), np.float32), np.zeros((TERMS, SIDE, width), np.float32)
    padded = np.zeros((MEANS, width + 2 * PAD), np.float32)
    term_padded = np.zeros((TERMS, width + 2 * PAD), np.float32)
    sums, term_sums = np.empty((MEANS, width), np.float32), np.empty((TERMS, width), np.float32)
    wide = np.empty(width, np.float32)
    pixels = f4(height * (width // 3))
    plain, similar = (f4(1.0) - ssim_lambda) / pixels, ssim_lambda / pixels
    for new in range(first - 2 * RADIUS, last + 2 * RADIUS):
        slot = new % SIDE
        if 0 <= new < height:
            write_products(image[new], photo[new], padded)
            sum_rows(padded, rings, slot)
        else:
            rings[:, slot] = f4(0.0)
        window = new - RADIUS  # the row whose windows are complete
        if 0 <= window < height and window >= first - RADIUS:
            sum_columns(rings, slot, sums)
            repeat(weight[window], wide)
            write_terms(sums, wide, term_padded)
            sum_rows(term_padded, term_rings, window % SIDE)
        else:
            term_rings[:, window % SIDE] = f4(0.0)
        row = window - RADIUS  # the row all of whose windows are complete
        if first <= row < last:
            sum_columns(term_rings, window % SIDE, term_sums)
            repeat(weight[row], wide)
            errors[row] = write_gradient(term_sums, image[row], photo[row], wide, plain, similar, gradient[row])
