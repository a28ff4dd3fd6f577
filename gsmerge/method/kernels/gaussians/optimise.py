"""Change Gaussians during a fit: take steps of the optimiser, and cut Gaussians at the edges of photos.

The edges are the planes through the camera and the borders of the picture.
"""

from __future__ import annotations

import numpy as np

from gsmerge.method.kernels.signature import STATUS, f4, f8, i4, i8, native, u1

# First columns of mean, log scale, quaternion, logit of the opacity and colour in the parameters, and number of all
# columns
MEAN = 0
SIZE = 3
QUAT = 6
LOGIT = 10
COLOR = 11
COLUMNS = 14
MAX_FIT_LOGIT = np.float32(6.9)
MIN_FIT_LOGIT = np.float32(-5.5)
NUM_EDGES = 4  # edges of a photo


@native(
    STATUS, x=f4("n", COLUMNS, out=True), x0=f4("n", COLUMNS), m=f4("n", COLUMNS, out=True),
    v=f4("n", COLUMNS, out=True), units=f4("n"), box_shares=f4("n"), min_sizes=f4("n"), fixed=u1("n"),
    ids=i4("k"), g_means=f4("k", 3), g_quats=f4("k", 4), g_scales=f4("k", 3), g_opacities=f4("k"), g_colors=f4("k", 3),
    rates=f4(COLUMNS), limits=f4(5), betas=f4(2), regs=f4(2), step=i8(least=1), first=i8(least=0, most="k"),
    last=i8(least="first", most="k"), means=f4("n", 3, out=True), quats=f4("n", 4, out=True),
    scales=f4("n", 3, out=True), opacities=f4("n", out=True), colors=f4("n", 3, out=True),
)  # fmt: skip
def adam(
    x, x0, m, v, units, box_shares, min_sizes, fixed, ids, g_means, g_quats, g_scales, g_opacities, g_colors, rates,
    limits, betas, regs, step, first, last, means, quats, scales, opacities, colors,
):  # fmt: skip
    """Change the rows ``ids[first]`` to ``ids[last - 1]`` of parameters ``x [n,COLUMNS]`` by one Adam step.

    Parameters stay in a box around the parameters ``x0`` at the start of the fit. The momentum is Nesterov's, which
    looks ahead to the first moment of the next step (Dozat, 2016). The components of the mean share one second moment,
    and so do those of the quaternion, so that steps rotate with the scene. Rows that are not in ``ids`` keep their
    parameters and moments ``m`` and ``v``.

    Args:
        units: ``[n]`` sizes of the Gaussians at the start, which are the units of their means.
        box_shares: ``[n]`` share of the box for mean and log scale that each Gaussian may use.
        min_sizes: ``[n]`` least log scale of each Gaussian, even if it is outside the box.
        ids: ``[k]`` rows with a gradient, each once. The gradients have k rows.
        rates: Learning rates of mean (in ``units``), log scale, quaternion, logit and colour.
        limits: Half sides of the box for mean (in ``units``), log scale and logit. The last two numbers are how much
            the largest log scale may exceed the second largest one, and how much it may exceed ``min_sizes``. Of the
            last two limits the higher one counts.
        betas: Decays of the first and the second moment.
        regs: Numbers added to the gradients of opacities, and of scales in ``units``.
        step: Number of the step, from 1.
        means, quats, scales, opacities, colors: Written: the new parameters as the rasterizer takes them.
    """


@native(
    STATUS, quats=f4("n", 4), scales=f4("n", 3), normals=f8("v", NUM_EDGES, 3), offsets=f8("v", NUM_EDGES),
    first=i8(least=0, most="n"), last=i8(least="first", most="n"), means=f4("n", 3, out=True),
    covars=f8("n", 3, 3, out=True), is_cut=u1("n", out=True),
)  # fmt: skip
def cut_at_edges(quats, scales, normals, offsets, first, last, means, covars, is_cut):
    """Cut Gaussians, of the rows ``first`` to ``last - 1``, that reach past the edges of all v photos.

    A Gaussian is cut at the nearest edge of the photo in which it lies deepest. Distances from edges are measured in
    standard deviations of the Gaussian across the plane of the edge. If the mean is within two standard deviations of
    the edge, the Gaussian gets the moments of its part inside (truncated normal distribution). A Gaussian is cut at
    most twice, because a corner has two edges. Gaussians farther outside do not change. ``gsmerge.method.fit.edges``
    splits Gaussians at the same edges, which it finds by the same rule.

    Args:
        normals: Outward unit normals of the planes through the cameras and the edges of their photos.
        offsets: Offsets of the planes. Points x inside have ``normal @ x <= offset``.
        means: Means, written for Gaussians that are cut.
        covars: Covariances, written for Gaussians that are cut.
        is_cut: Written: 1 for Gaussians that are cut.
    """
