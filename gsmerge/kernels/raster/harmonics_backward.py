"""The backward pass of view-dependent colours: to the coefficients and, through the viewing direction, to the means."""

from __future__ import annotations

import numpy as np
from numpy import float32 as f4

from gsmerge.kernels.jit import kernel
from gsmerge.kernels.raster.lanes import LANES
from gsmerge.kernels.raster.prefetch import prefetch_row
from gsmerge.kernels.raster.triples import TRIPLES, spread_triples, turn, weigh_triples

BLOCK = 128
# Planes of a block. In: direction 0-2 (any length), dots 4 on: per higher harmonic its coefficients times the colour's
# gradient. Out, in their place: gradient of the mean, values of the harmonics.
PLANES = 4 + 2 * LANES + 6
P = tuple(np.uint64(BLOCK * plane) for plane in range(PLANES))
X, Y, Z, INVERSE, DOTS, UNIT, RED = 0, 1, 2, 3, 3, PLANES - 6, PLANES - 3  # plane DOTS + k belongs to harmonic k >= 1


@kernel
def _first_degree(block):
    """Unit directions, their inverse lengths, and degree 1."""
    c = f4(0.4886025119029199)
    for lane in range(BLOCK):
        i = np.uint64(lane)
        x, y, z = block[i + P[X]], block[i + P[Y]], block[i + P[Z]]
        square = x * x + y * y + z * z
        seen = square > f4(0.0)
        inverse = f4(1.0) / np.sqrt(square if seen else f4(1.0))
        inverse = inverse if seen else f4(0.0)
        x, y, z = x * inverse, y * inverse, z * inverse
        block[i + P[UNIT]], block[i + P[UNIT + 1]], block[i + P[UNIT + 2]] = x, y, z
        block[i + P[X]] = -c * block[i + P[DOTS + 3]]
        block[i + P[Y]] = -c * block[i + P[DOTS + 1]]
        block[i + P[Z]] = c * block[i + P[DOTS + 2]]
        block[i + P[INVERSE]] = inverse
        block[i + P[DOTS + 1]], block[i + P[DOTS + 2]], block[i + P[DOTS + 3]] = -c * y, c * z, -c * x


@kernel
def _second_degree(block):
    a, b, c = f4(1.0925484305920792), f4(0.31539156525252005), f4(0.5462742152960396)
    two = f4(2.0)
    for lane in range(BLOCK):
        i = np.uint64(lane)
        x, y, z = block[i + P[UNIT]], block[i + P[UNIT + 1]], block[i + P[UNIT + 2]]
        e4, e5, e6 = block[i + P[DOTS + 4]], block[i + P[DOTS + 5]], b * block[i + P[DOTS + 6]]
        e7, e8 = block[i + P[DOTS + 7]], c * block[i + P[DOTS + 8]]
        block[i + P[X]] += a * (y * e4 - z * e7) + two * x * (e8 - e6)
        block[i + P[Y]] += a * (x * e4 - z * e5) - two * y * (e6 + e8)
        block[i + P[Z]] += f4(4.0) * z * e6 - a * (y * e5 + x * e7)
        block[i + P[DOTS + 4]], block[i + P[DOTS + 5]], block[i + P[DOTS + 7]] = a * x * y, -a * y * z, -a * x * z
        block[i + P[DOTS + 6]] = b * (two * z * z - x * x - y * y)
        block[i + P[DOTS + 8]] = c * (x * x - y * y)


@kernel
def _third_degree(block):
    a, b, c = f4(0.5900435899266435), f4(2.890611442640554), f4(0.4570457994644658)
    d, e, two, three, four = f4(0.3731763325901154), f4(1.445305721320277), f4(2.0), f4(3.0), f4(4.0)
    for lane in range(BLOCK):
        i = np.uint64(lane)
        x, y, z = block[i + P[UNIT]], block[i + P[UNIT + 1]], block[i + P[UNIT + 2]]
        xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
        e9, e10, e11 = a * block[i + P[DOTS + 9]], b * block[i + P[DOTS + 10]], c * block[i + P[DOTS + 11]]
        e12, e13 = d * block[i + P[DOTS + 12]], c * block[i + P[DOTS + 13]]
        e14, e15 = e * block[i + P[DOTS + 14]], a * block[i + P[DOTS + 15]]
        block[i + P[X]] += (
            yz * e10 + two * xy * (e11 - three * e9) - f4(6.0) * xz * e12 - (four * zz - three * xx - yy) * e13
            + two * xz * e14 - three * (xx - yy) * e15
        )  # fmt: skip
        block[i + P[Y]] += (
            xz * e10 + two * xy * (e13 + three * e15) - f4(6.0) * yz * e12 - (four * zz - xx - three * yy) * e11
            - two * yz * e14 - three * (xx - yy) * e9
        )  # fmt: skip
        block[i + P[Z]] += (
            xy * e10 - f4(8.0) * (yz * e11 + xz * e13) + three * (two * zz - xx - yy) * e12 + (xx - yy) * e14
        )
        block[i + P[DOTS + 9]] = -a * y * (three * xx - yy)
        block[i + P[DOTS + 10]] = b * xy * z
        block[i + P[DOTS + 11]] = -c * y * (four * zz - xx - yy)
        block[i + P[DOTS + 12]] = d * z * (two * zz - three * (xx + yy))
        block[i + P[DOTS + 13]] = -c * x * (four * zz - xx - yy)
        block[i + P[DOTS + 14]] = e * z * (xx - yy)
        block[i + P[DOTS + 15]] = -a * x * (xx - three * yy)


@kernel
def _fourth_degree(block):
    a, b, c = f4(2.5033429417967046), f4(1.7701307697799304), f4(0.9461746957575601)
    d, e = f4(0.6690465435572892), f4(0.10578554691520431)
    f, g = f4(0.47308734787878004), f4(0.6258357354491761)
    one, two, three, four, seven = f4(1.0), f4(2.0), f4(3.0), f4(4.0), f4(7.0)
    for lane in range(BLOCK):
        i = np.uint64(lane)
        x, y, z = block[i + P[UNIT]], block[i + P[UNIT + 1]], block[i + P[UNIT + 2]]
        xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
        e16, e17, e18 = a * block[i + P[DOTS + 16]], b * block[i + P[DOTS + 17]], c * block[i + P[DOTS + 18]]
        e19, e20, e21 = d * block[i + P[DOTS + 19]], e * block[i + P[DOTS + 20]], d * block[i + P[DOTS + 21]]
        e22, e23, e24 = f * block[i + P[DOTS + 22]], b * block[i + P[DOTS + 23]], four * g * block[i + P[DOTS + 24]]
        wide, tall, flat = three * xx - yy, xx - three * yy, xx - yy
        block[i + P[X]] += (
            y * wide * e16 - f4(6.0) * xy * z * e17 + (seven * zz - one) * (y * e18 + two * x * e22)
            - z * (seven * zz - three) * e21 - three * z * flat * e23 + x * tall * e24
        )  # fmt: skip
        block[i + P[Y]] += (
            x * tall * e16 + f4(6.0) * xy * z * e23 + (seven * zz - one) * (x * e18 - two * y * e22)
            - z * (seven * zz - three) * e19 - three * z * flat * e17 - y * wide * e24
        )  # fmt: skip
        block[i + P[Z]] += (
            f4(14.0) * z * (xy * e18 + flat * e22) - y * wide * e17 - x * tall * e23
            - three * (seven * zz - one) * (y * e19 + x * e21) + f4(20.0) * z * (seven * zz - three) * e20
        )  # fmt: skip
        block[i + P[DOTS + 16]] = a * xy * flat
        block[i + P[DOTS + 17]] = -b * yz * wide
        block[i + P[DOTS + 18]] = c * xy * (seven * zz - one)
        block[i + P[DOTS + 19]] = -d * yz * (seven * zz - three)
        block[i + P[DOTS + 20]] = e * (zz * (f4(35.0) * zz - f4(30.0)) + three)
        block[i + P[DOTS + 21]] = -d * xz * (seven * zz - three)
        block[i + P[DOTS + 22]] = f * flat * (seven * zz - one)
        block[i + P[DOTS + 23]] = -b * xz * tall
        block[i + P[DOTS + 24]] = g * (xx * tall - yy * wide)


@kernel
def _across(block):
    """Turn the gradient of the unit direction into that of the mean: what is across it, over the distance."""
    for lane in range(BLOCK):
        i = np.uint64(lane)
        x, y, z = block[i + P[UNIT]], block[i + P[UNIT + 1]], block[i + P[UNIT + 2]]
        gx, gy, gz, inverse = block[i + P[X]], block[i + P[Y]], block[i + P[Z]], block[i + P[INVERSE]]
        along = x * gx + y * gy + z * gz
        block[i + P[X]] = (gx - along * x) * inverse
        block[i + P[Y]] = (gy - along * y) * inverse
        block[i + P[Z]] = (gz - along * z) * inverse


@kernel
def _passed(colors, grad_colors, i):
    """A colour's gradient, without the channels that are cut at 0."""
    zero = f4(0.0)
    # loaded before they are chosen from: no branch
    red, green, blue = grad_colors[i, 0], grad_colors[i, 1], grad_colors[i, 2]
    return (
        red if colors[i, 0] > zero else zero,
        green if colors[i, 1] > zero else zero,
        blue if colors[i, 2] > zero else zero,
    )


@kernel
def _harmonics_backward(block, rows, num):
    """Replace the rows of dots by those of the harmonics' values, and the directions by the gradients of the means."""
    for group in range(0, num, LANES):
        for lane in range(0, BLOCK, LANES):
            turn(rows, group * BLOCK + lane * LANES, LANES, block, (DOTS + 1 + group) * BLOCK + lane, BLOCK)
    if num >= 3:
        _first_degree(block)
    if num >= 8:
        _second_degree(block)
    if num >= 15:
        _third_degree(block)
    if num >= 24:
        _fourth_degree(block)
    _across(block)
    for group in range(0, num, LANES):
        for lane in range(0, BLOCK, LANES):
            turn(block, (DOTS + 1 + group) * BLOCK + lane, BLOCK, rows, group * BLOCK + lane * LANES, LANES)


@kernel
def view_colors_backward(means, shN, ids, eye, first, last, colors, grad_colors, grad_sh0, grad_shN, grad_means):
    """Gradients of a range of the listed Gaussians through their colours seen from ``eye``.

    Args:
        means: ``[n,3]`` float32.
        shN: ``[n,k-1,3]`` float32.
        ids: ``[m]`` int32.
        eye: ``[3]`` float32.
        first: Start of the range.
        last: End of the range, exclusive.
        colors: ``[m,3]`` float32, as seen; no gradient passes where they are 0.
        grad_colors: ``[m,3]`` float32.
        grad_sh0: ``[m,1,3]`` float32, written.
        grad_shN: ``[m,k-1,3]`` float32, written.
        grad_means: ``[m,3]`` float32, written.
    """
    num = shN.shape[1]
    size = 3 * num
    coefficients, grad_coefficients = shN.reshape(-1), grad_shN.reshape(-1)
    block, rows = np.zeros(PLANES * BLOCK, np.float32), np.zeros(2 * LANES * BLOCK, np.float32)
    done = np.zeros(TRIPLES, np.float32)
    # The last coefficients again, with space behind them: what is read beyond a row must exist.
    beyond = max(0, coefficients.shape[0] - TRIPLES + 1)
    end = np.zeros(2 * TRIPLES, np.float32)
    for i in range(beyond, coefficients.shape[0]):
        end[i - beyond] = coefficients[i]
    c, seen = f4(0.28209479177387814), f4(1.0) if num > 0 else f4(0.0)
    for start in range(first, last, BLOCK):
        count = min(BLOCK, last - start)
        for lane in range(count):
            i, j = np.uint64(start + lane), np.uint64(lane)
            k = np.uint64(ids[i])
            red, green, blue = _passed(colors, grad_colors, i)
            block[j + P[RED]], block[j + P[RED + 1]], block[j + P[RED + 2]] = red, green, blue
            grad_sh0[i, 0, 0], grad_sh0[i, 0, 1], grad_sh0[i, 0, 2] = c * red, c * green, c * blue
            block[j], block[j + P[Y]] = means[k, 0] - eye[0], means[k, 1] - eye[1]
            block[j + P[Z]] = means[k, 2] - eye[2]
            for group in range(0, num, LANES):
                at, to = int(k) * size + 3 * group, group * BLOCK + lane * LANES
                if at < beyond:
                    weigh_triples(coefficients, at, red, green, blue, rows, to)
                else:
                    weigh_triples(end, at - beyond, red, green, blue, rows, to)
        if num > 0:
            _harmonics_backward(block, rows, num)
        for lane in range(count):
            i, j = np.uint64(start + lane), np.uint64(lane)
            # the next block's coefficients, while these are written
            ahead = np.uint64(ids[min(start + lane + BLOCK, last - 1)]) * np.uint64(size)
            for q in range(0, size, LANES):
                prefetch_row(coefficients, ahead + np.uint64(q))
            red, green, blue = block[j + P[RED]], block[j + P[RED + 1]], block[j + P[RED + 2]]
            # What is written beyond a row is the next one's, which follows.
            for group in range(0, num, LANES):
                at, to = (start + lane) * size + 3 * group, group * BLOCK + lane * LANES
                if at + TRIPLES <= last * size:
                    spread_triples(rows, to, red, green, blue, grad_coefficients, at)
                else:
                    spread_triples(rows, to, red, green, blue, done, 0)
                    for q in range(min(TRIPLES, size - 3 * group)):
                        grad_coefficients[at + q] = done[q]
            grad_means[i, 0], grad_means[i, 1], grad_means[i, 2] = (
                seen * block[j], seen * block[j + P[Y]], seen * block[j + P[Z]],
            )  # fmt: skip
