"""Merge Gaussians in pairs, the cheapest pair of a cell of neighbours first."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import STATUS, declare, f4, f8, i4, i8, native

CELL = 64  # most Gaussians of a cell
WORK = 17  # rows of the work space


@native(
    quats=f4("n", 4), scales=f4("n", 3), opacities=f4("n"), flatness=f8(), covars=f4("n", 6, out=True),
    masses=f4("n", out=True),
)  # fmt: skip
def gaussian_moments(quats, scales, opacities, flatness, covars, masses):
    """Write covariances ``[n,6]`` (xx, xy, xz, yy, yz, zz) and masses ``[n]``.

    A mass is the opacity times the root of (ab)^2 + (bc)^2 + (ca)^2 of the scales, about the area seen from any side.

    Args:
        quats: ``[n,4]`` wxyz of any length.
        scales: ``[n,3]`` standard deviations.
        flatness: Least scale, as a share of the largest.
        covars: Written.
        masses: Written.
    """


# ``work`` and ``spare`` are work space for a cell
_agglomerate = declare(
    "agglomerate", STATUS, means=f8("n", 3), covars=f4("n", 6), masses=f4("n"), weights=f4("n"), colors=f4("n", 3),
    order=i8("n", least=0, below="n"), starts=i8("ends", least=0, ascending=True), color_weight=f8(),
    least_share=f8(), first=i8(), last=i8(), work=f4(WORK, CELL, out=True), spare=i4(3, CELL, out=True),
    pairs=i4("n", 2, out=True), costs=f4("n", out=True),
)  # fmt: skip


def agglomerate(
    means, covars, masses, weights, colors, order, starts, color_weight, least_share, first, last, pairs, costs
):
    """Merge in cells ``first`` to ``last`` the cheapest remaining pair, again and again, and write the merges.

    The cost of a pair is the sum of Runnalls' bound (2007) on the divergence of its merging, per mass, and the squared
    distance of colours, times the sum of both weights. The written cost of a merge is at least that of the merge before
    it in its cell, so the merges up to any cost are the first ones of every cell.

    Args:
        covars: ``[n,6]`` float32, upper triangles.
        weights: ``[n]`` float32, which make costs of different cells comparable; weights of merged Gaussians add up.
        order: ``[n]`` int64 rows, cell by cell.
        starts: ``[c+1]`` int64 starts of the cells in the order, at most ``CELL`` apart.
        color_weight: Weight of squared distances of colours against nats.
        least_share: Share of a cell's Gaussians that remains; at least one remains.
        first: First cell.
        last: Last cell, exclusive.
        pairs: ``[n,2]`` int32, written from each cell's start on: the row that remains after a merge, and the other.
        costs: ``[n]`` float32 costs of the merges, written like ``pairs``. Entries without a merge do not change.
    """
    work, spare = np.empty((WORK, CELL), np.float32), np.empty((3, CELL), np.int32)
    _agglomerate(
        means, covars, masses, weights, colors, order, starts, color_weight, least_share, first, last, work, spare,
        pairs, costs,
    )  # fmt: skip


@native(
    STATUS, pairs=i4("m", 2), means=f8("n", 3, out=True), covars=f4("n", 6, out=True), masses=f4("n", out=True),
    weights=f4("n", out=True), sh=f4("n", "columns", out=True), sizes=i4("n", out=True),
)  # fmt: skip
def merge_pairs(pairs, means, covars, masses, weights, sh, sizes):
    """Replace the first row of each pair by the Gaussian with the moments of both rows, one pair after another.

    Masses, weights and ``sizes``, the numbers of merged Gaussians, add up. Harmonics are averaged by mass. The second
    rows do not change.
    """
