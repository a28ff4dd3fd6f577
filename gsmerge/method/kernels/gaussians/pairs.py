"""Merge Gaussians in pairs. In each cell of neighbours, the cheapest pair is merged first."""

from __future__ import annotations

import numpy as np

from gsmerge.method.kernels.signature import STATUS, declare, f4, f8, i4, i8, native

CELL = 64  # most Gaussians of a cell
WORK = 17  # rows of the work space for a cell


@native(
    quats=f4("n", 4), scales=f4("n", 3), opacities=f4("n"), flatness=f8(), covars=f4("n", 6, out=True),
    masses=f4("n", out=True),
)  # fmt: skip
def gaussian_moments(quats, scales, opacities, flatness, covars, masses):
    """Write the covariances ``[n,6]`` (xx, xy, xz, yy, yz, zz) and the masses ``[n]`` of Gaussians.

    A mass is the opacity times the root of (ab)^2 + (bc)^2 + (ca)^2, where a, b and c are the scales. The root is about
    proportional to the area of the Gaussian that is visible from any side.

    Args:
        quats: ``[n,4]`` wxyz of any length.
        scales: ``[n,3]`` standard deviations.
        flatness: Least scale, as a share of the largest scale. Smaller scales count as this.
        covars: Written, float32.
        masses: Written, float32.
    """


# `work` and `spare` are work space for a cell
_agglomerate = declare(
    "agglomerate", STATUS, means=f8("n", 3), covars=f4("n", 6), masses=f4("n"), weights=f4("n"), colors=f4("n", 3),
    order=i8("n", least=0, below="n"), starts=i8("ends", least=0, ascending=True), color_weight=f8(),
    least_share=f8(), first=i8(), last=i8(), work=f4(WORK, CELL, out=True), spare=i4(3, CELL, out=True),
    pairs=i4("n", 2, out=True), costs=f4("n", out=True),
)  # fmt: skip


def agglomerate(
    means, covars, masses, weights, colors, order, starts, color_weight, least_share, first, last, pairs, costs
):
    """Plan merges in some cells, without changing the Gaussians. The cheapest pair of a cell is always merged next.

    The cost of a pair is the difference of its two Gaussians times the sum of both weights. The difference of two
    Gaussians is Runnalls' bound (2007) on the divergence that the merge causes, per mass, plus the squared difference
    of colours. A merge costs at least as much as the merge before it in the same cell. Costs never fall within a cell,
    so the merges up to any cost are the first merges of each cell.

    Args:
        covars: ``[n,6]`` float32, upper triangles.
        weights: ``[n]`` float32 factors of the costs. Weights of merged Gaussians add up.
        order: ``[n]`` int64 rows, cell by cell.
        starts: ``[c+1]`` int64 starts of the cells in the order. A cell has at most ``CELL`` rows.
        color_weight: Weight of squared differences of colours, relative to a divergence in nats.
        least_share: Merges stop when this share of a cell's Gaussians is left, or a single one.
        first: First cell.
        last: Last cell, exclusive.
        pairs: ``[n,2]`` int32, written from each cell's start on: the row that gets the merged Gaussian, and the other.
        costs: ``[n]`` float32 costs of the merges, written from each cell's start on. Other entries do not change.
    """
    work = np.empty((WORK, CELL), np.float32)
    spare = np.empty((3, CELL), np.int32)
    _agglomerate(
        means, covars, masses, weights, colors, order, starts, color_weight, least_share, first, last, work, spare,
        pairs, costs,
    )  # fmt: skip


@native(
    STATUS, pairs=i4("m", 2), means=f8("n", 3, out=True), covars=f4("n", 6, out=True), masses=f4("n", out=True),
    weights=f4("n", out=True), sh=f4("n", "columns", out=True), sizes=i4("n", out=True),
)  # fmt: skip
def merge_pairs(pairs, means, covars, masses, weights, sh, sizes):
    """Replace the first row of each pair by the Gaussian with the moments of both, one pair after another.

    A row may be in several pairs. Masses, weights and ``sizes``, which are numbers of input Gaussians, add up.
    Harmonics are averaged by mass. The second row of a pair does not change.
    """
