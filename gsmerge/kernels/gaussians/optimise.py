"""One optimiser step on all parameters of all Gaussians."""

from __future__ import annotations

import numpy as np
from numpy import float32 as f4

from gsmerge.kernels.jit import kernel

# columns of the state: mean 3, log scale 3, quaternion 4, opacity logit 1, colour 3
MEAN, SIZE, QUAT, LOGIT, COLOR, COLUMNS = 0, 3, 6, 10, 11, 14
MAX_LOGIT, MIN_LOGIT = f4(6.9), f4(-5.5)


@kernel
def _gather(row, unit, k, g_means, g_quats, g_scales, g_opacities, g_colors, scale, opacity):
    """Gradient row of a Gaussian in the optimiser's parameters: means in units of its size, log, logit."""
    for c in range(3):
        row[MEAN + c] = g_means[k, c] * unit
        row[SIZE + c] = g_scales[k, c] * scale[c]
        row[COLOR + c] = g_colors[k, c]
    for c in range(4):
        row[QUAT + c] = g_quats[k, c]
    row[LOGIT] = g_opacities[k] * opacity * (f4(1.0) - opacity)


@kernel
def _confine(x, x0, unit, share, least, limits):
    """Confine parameters to the box about the start, with least size, colours in range and a unit quaternion."""
    grown = share * limits[1]
    d0, d1, d2 = x[0] - x0[0], x[1] - x0[1], x[2] - x0[2]
    far, reach = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2), share * limits[0] * unit
    if far > reach:
        f = reach / far
        x[0], x[1], x[2] = x0[0] + f * d0, x0[1] + f * d1, x0[2] + f * d2
    for c in range(SIZE, SIZE + 3):
        x[c] = max(least, min(x0[c] + grown, max(x0[c] - grown, x[c])))
    logit = min(x0[LOGIT] + limits[2], max(x0[LOGIT] - limits[2], x[LOGIT]))
    x[LOGIT] = min(MAX_LOGIT, max(MIN_LOGIT, logit))
    for c in range(COLOR, COLOR + 3):
        x[c] = min(max(f4(1.05), x0[c]), max(min(f4(-0.05), x0[c]), x[c]))
    norm = x[6] * x[6] + x[7] * x[7] + x[8] * x[8] + x[9] * x[9]
    norm = f4(1.0) / np.sqrt(norm) if norm > f4(0.0) else f4(0.0)
    for c in range(QUAT, QUAT + 4):
        x[c] *= norm


@kernel
def adam(
    x, x0, m, v, units, box_shares, min_sizes, ids, g_means, g_quats, g_scales, g_opacities, g_colors, rates, limits,
    betas, step, first, last, means, quats, scales, opacities, colors,
):  # fmt: skip
    """Adam on the rows ``ids[first]`` to ``ids[last - 1]`` of the state ``x [n,COLUMNS]``, then the box about ``x0``.

    The mean and the quaternion share one second moment over their components, so that the step turns with the
    scene. Sparse: rows that a view does not show keep their parameters and moments.

    Args:
        box_shares: ``[n]`` of the limits of mean and log scale that each Gaussian may use.
        min_sizes: ``[n]`` least log scale of each, whatever the box.
        ids: ``[k]`` rows with a gradient, each once; the gradients have k rows.
        rates: Of mean (in units of each Gaussian's size), log scale, quaternion, logit, colour.
        limits: Of the mean (in sizes), log scale, logit.
        betas: Decay of the first and second moment.
        step: From 1.
        means, quats, scales, opacities, colors: What the new state means to the rasterizer, written.
    """
    b1, b2 = betas[0], betas[1]
    c1 = f4(1.0) / (f4(1.0) - b1 ** f4(step))
    c2 = f4(1.0) / (f4(1.0) - b2 ** f4(step))
    row = np.zeros(COLUMNS, np.float32)
    energy = np.empty(COLUMNS, np.float32)
    for k in range(first, last):
        i = np.int64(ids[k])
        unit = units[i]
        _gather(row, unit, k, g_means, g_quats, g_scales, g_opacities, g_colors, scales[i], opacities[i])
        for c in range(COLUMNS):
            energy[c] = row[c] * row[c]
        shared = (energy[0] + energy[1] + energy[2]) / f4(3.0)
        energy[0], energy[1], energy[2] = shared, shared, shared
        shared = (energy[6] + energy[7] + energy[8] + energy[9]) / f4(3.0)
        energy[6], energy[7], energy[8], energy[9] = shared, shared, shared, shared
        for c in range(COLUMNS):
            m[i, c] = b1 * m[i, c] + (f4(1.0) - b1) * row[c]
            v[i, c] = b2 * v[i, c] + (f4(1.0) - b2) * energy[c]
            move = rates[c] * m[i, c] * c1 / (np.sqrt(v[i, c] * c2) + f4(1e-15))
            x[i, c] -= move * unit if c < SIZE else move
        _confine(x[i], x0[i], unit, box_shares[i], min_sizes[i], limits)
        for c in range(3):
            means[i, c], colors[i, c] = x[i, c], x[i, COLOR + c]
            scales[i, c] = np.exp(x[i, SIZE + c])
        for c in range(4):
            quats[i, c] = x[i, QUAT + c]
        opacities[i] = f4(1.0) / (f4(1.0) + np.exp(-x[i, LOGIT]))
