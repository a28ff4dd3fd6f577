"""Optimiser step of :func:`gsmerge.fit.gpu.adam.adam_step` as one Triton kernel, imported only where Triton is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import triton
import triton.language as tl

if TYPE_CHECKING:
    from torch import Tensor

    from gsmerge.fit.gpu.adam import DeviceState, StepGradients
    from gsmerge.settings.fit import Tuning

BLOCK = 128  # Gaussians to a program
TINY = tl.constexpr(1e-15)  # beside the root of the second moment
MIN_LOGIT, MAX_LOGIT = tl.constexpr(-5.5), tl.constexpr(6.9)  # those of the kernel; a test compares them
DARKEST, BRIGHTEST = tl.constexpr(-0.05), tl.constexpr(1.05)


@triton.jit
def _move(m, v, at, mask, gradient, energy, b1, b2, c1, c2):
    """Update the moments of one column, and return what Adam moves it by for a rate of one."""
    first = b1 * tl.load(m + at, mask, 0.0) + (1.0 - b1) * gradient
    second = b2 * tl.load(v + at, mask, 0.0) + (1.0 - b2) * energy
    tl.store(m + at, first, mask)
    tl.store(v + at, second, mask)
    return first * c1 / (tl.sqrt(second * c2) + TINY)


@triton.jit
def _clamp(value, low, high):
    return tl.minimum(high, tl.maximum(low, value))


@triton.jit
def _step_means(x, x0, m, v, g_means, means, rates, row, i, mask, unit, share, max_shift, b1, b2, c1, c2):
    g0 = tl.load(g_means + 3 * i, mask, 0.0) * unit
    g1 = tl.load(g_means + 3 * i + 1, mask, 0.0) * unit
    g2 = tl.load(g_means + 3 * i + 2, mask, 0.0) * unit
    energy = (g0 * g0 + g1 * g1 + g2 * g2) / 3.0
    s0, s1, s2 = tl.load(x0 + row, mask, 0.0), tl.load(x0 + row + 1, mask, 0.0), tl.load(x0 + row + 2, mask, 0.0)
    d0 = _move(m, v, row, mask, g0, energy, b1, b2, c1, c2) * tl.load(rates) * unit
    d1 = _move(m, v, row + 1, mask, g1, energy, b1, b2, c1, c2) * tl.load(rates + 1) * unit
    d2 = _move(m, v, row + 2, mask, g2, energy, b1, b2, c1, c2) * tl.load(rates + 2) * unit
    n0, n1 = tl.load(x + row, mask, 0.0) - d0, tl.load(x + row + 1, mask, 0.0) - d1
    n2 = tl.load(x + row + 2, mask, 0.0) - d2
    o0, o1, o2 = n0 - s0, n1 - s1, n2 - s2
    far, reach = tl.sqrt(o0 * o0 + o1 * o1 + o2 * o2), share * max_shift * unit
    outside = far > reach
    factor = reach / tl.where(outside, far, 1.0)
    n0 = tl.where(outside, s0 + factor * o0, n0)
    n1 = tl.where(outside, s1 + factor * o1, n1)
    n2 = tl.where(outside, s2 + factor * o2, n2)
    tl.store(x + row, n0, mask)
    tl.store(x + row + 1, n1, mask)
    tl.store(x + row + 2, n2, mask)
    tl.store(means + 3 * i, n0, mask)
    tl.store(means + 3 * i + 1, n1, mask)
    tl.store(means + 3 * i + 2, n2, mask)


@triton.jit
def _step_quats(x, m, v, g_quats, quats, rates, row, i, mask, b1, b2, c1, c2):
    g0, g1 = tl.load(g_quats + 4 * i, mask, 0.0), tl.load(g_quats + 4 * i + 1, mask, 0.0)
    g2, g3 = tl.load(g_quats + 4 * i + 2, mask, 0.0), tl.load(g_quats + 4 * i + 3, mask, 0.0)
    energy = (g0 * g0 + g1 * g1 + g2 * g2 + g3 * g3) / 3.0
    at = row + 6
    n0 = tl.load(x + at, mask, 0.0) - tl.load(rates + 6) * _move(m, v, at, mask, g0, energy, b1, b2, c1, c2)
    n1 = tl.load(x + at + 1, mask, 0.0) - tl.load(rates + 7) * _move(m, v, at + 1, mask, g1, energy, b1, b2, c1, c2)
    n2 = tl.load(x + at + 2, mask, 0.0) - tl.load(rates + 8) * _move(m, v, at + 2, mask, g2, energy, b1, b2, c1, c2)
    n3 = tl.load(x + at + 3, mask, 0.0) - tl.load(rates + 9) * _move(m, v, at + 3, mask, g3, energy, b1, b2, c1, c2)
    norm = tl.sqrt(n0 * n0 + n1 * n1 + n2 * n2 + n3 * n3)
    scale = tl.where(norm > 0.0, 1.0 / tl.where(norm > 0.0, norm, 1.0), 0.0)
    n0, n1, n2, n3 = n0 * scale, n1 * scale, n2 * scale, n3 * scale
    tl.store(x + at, n0, mask)
    tl.store(x + at + 1, n1, mask)
    tl.store(x + at + 2, n2, mask)
    tl.store(x + at + 3, n3, mask)
    tl.store(quats + 4 * i, n0, mask)
    tl.store(quats + 4 * i + 1, n1, mask)
    tl.store(quats + 4 * i + 2, n2, mask)
    tl.store(quats + 4 * i + 3, n3, mask)


@triton.jit(do_not_specialize=["count"])  # or it would be compiled again when the number of Gaussians grows
def _step(
    x, x0, m, v, units, shares, least, g_means, g_quats, g_scales, g_opacities, g_colors, reached, rates,
    means, quats, scales, opacities, colors, count, opacity_pull, scale_pull,
    max_shift, max_scale, max_opacity, b1, b2, c1, c2, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = (i < count) & (tl.load(reached + i, i < count, 0) != 0)
    row = i * 14
    unit, share = tl.load(units + i, mask, 1.0), tl.load(shares + i, mask, 1.0)
    smallest = tl.load(least + i, mask, 0.0)
    _step_means(x, x0, m, v, g_means, means, rates, row, i, mask, unit, share, max_shift, b1, b2, c1, c2)
    _step_quats(x, m, v, g_quats, quats, rates, row, i, mask, b1, b2, c1, c2)
    for c in tl.static_range(3):
        at = row + 3 + c
        size = tl.load(scales + 3 * i + c, mask, 0.0)
        g = (tl.load(g_scales + 3 * i + c, mask, 0.0) + scale_pull / unit) * size
        new = tl.load(x + at, mask, 0.0) - tl.load(rates + 3 + c) * _move(m, v, at, mask, g, g * g, b1, b2, c1, c2)
        start = tl.load(x0 + at, mask, 0.0)
        new = _clamp(new, start - share * max_scale, start + share * max_scale)
        new = tl.maximum(new, smallest)
        tl.store(x + at, new, mask)
        tl.store(scales + 3 * i + c, tl.exp(new), mask)
    at = row + 10
    old = tl.load(opacities + i, mask, 0.0)
    g = (tl.load(g_opacities + i, mask, 0.0) + opacity_pull) * old * (1.0 - old)
    new = tl.load(x + at, mask, 0.0) - tl.load(rates + 10) * _move(m, v, at, mask, g, g * g, b1, b2, c1, c2)
    start = tl.load(x0 + at, mask, 0.0)
    new = _clamp(_clamp(new, start - max_opacity, start + max_opacity), MIN_LOGIT, MAX_LOGIT)
    tl.store(x + at, new, mask)
    tl.store(opacities + i, 1.0 / (1.0 + tl.exp(-new)), mask)
    for c in tl.static_range(3):
        at = row + 11 + c
        g = tl.load(g_colors + 3 * i + c, mask, 0.0)
        new = tl.load(x + at, mask, 0.0) - tl.load(rates + 11 + c) * _move(m, v, at, mask, g, g * g, b1, b2, c1, c2)
        start = tl.load(x0 + at, mask, 0.0)
        new = _clamp(new, tl.minimum(DARKEST, start), tl.maximum(BRIGHTEST, start))
        tl.store(x + at, new, mask)
        tl.store(colors + 3 * i + c, new, mask)


def launch(state: DeviceState, gradients: StepGradients, limits: Tuning, rates: Tensor, step: int) -> None:
    """Take the step of :func:`gsmerge.fit.gpu.adam.adam_step` with the Triton kernel, in place."""
    count, g = len(state), gradients
    if count == 0:
        return
    _step[(triton.cdiv(count, BLOCK),)](
        state.x, state.x0, state.m, state.v, state.units, state.box_shares, state.min_sizes,
        *(tensor.contiguous() for tensor in (g.means, g.quats, g.scales, g.opacities, g.colors)), g.reached, rates,
        state.means, state.quats, state.scales, state.opacities, state.colors, count,
        limits.opacity_reg / count, limits.scale_reg / count,
        limits.max_mean_shift, limits.max_scale_change, limits.max_opacity_change, limits.beta1, limits.beta2,
        1 / (1 - limits.beta1**step), 1 / (1 - limits.beta2**step), BLOCK=BLOCK,
    )  # fmt: skip
