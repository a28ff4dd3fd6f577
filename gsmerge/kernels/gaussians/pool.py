"""Sort members into groups, compute the moments of each group, and turn covariances into scales and rotations."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import STATUS, declare, f4, f8, i4, i8, native

_sort_labels = declare("sort_labels", STATUS, labels=i4("n"), starts=i8("ends", out=True), ids=i4("n", out=True))


def group_members(labels, count):
    """Sort members by label.

    Returns the start ``[count+1]`` int64 of each label in a list of rows, and this int32 list. Members with labels
    below 0 are left out.

    Args:
        labels: ``[n]`` int32, below ``count``.
        count: Number of labels.
    """
    starts, ids = np.empty(count + 1, np.int64), np.empty(len(labels), np.int32)
    _sort_labels(labels, starts, ids)
    return starts, ids[: starts[-1]]


# `caps` and `order` are work space for the longest group
_pool_groups = declare(
    "pool_groups", STATUS, starts=i8("ends", least=0, ascending=True), ids=i4("m"), means=f4("n", 3), quats=f4("n", 4),
    scales=f4("n", 3), opacities=f4("n"), sh0=f4("n", 1, 3), shN=f4("n", "rest", 3), footprints=f4("n"),
    own_covariance=i4(), caps=f8("longest", out=True), order=i8("longest", out=True),
    out_geometry=f8("groups", 13, out=True), out_sh=f4("groups", "bases", 3, out=True),
)  # fmt: skip


def pool(starts, ids, means, quats, scales, opacities, sh0, shN, footprints, own_covariance, out_geometry, out_sh):
    """Write the moments of every group, in float64 and about the mean of the group.

    Args:
        starts: ``[g+1]`` int64 starts of the groups in ``ids``, ascending from 0 or above.
        ids: ``[m]`` int32 rows of the members, group by group.
        means: ``[n,3]`` float32, as are the other columns of the members.
        quats: ``[n,4]`` wxyz of any length.
        scales: ``[n,3]`` standard deviations.
        footprints: ``[n]`` sizes of the members' pixels, world units.
        own_covariance: True to add the covariances of the members, with capped extents, to the covariance of their
            means. If false, only the covariance of the means counts (teacher_cov in the paper).
        out_geometry: ``[g,13]`` float64, written for groups with members: mean (3), covariance xx xy xz yy yz zz, sum
            of opacities, mass (as in the paper), integrated optical depth and footprint. The optical depth is the sum
            of -ln(1 - opacity) times disc area.
        out_sh: ``[g,k,3]`` float32, zero before, written: weighted means of the harmonics.
    """
    longest = int(np.diff(starts).max(initial=0))
    _pool_groups(
        starts, np.asarray(ids, np.int32), means, quats, scales, opacities, sh0, shN, footprints, own_covariance,
        np.empty(longest), np.empty(longest, np.int64), out_geometry, out_sh,
    )  # fmt: skip


@native(covars=f8("g", 3, 3), out_scales=f8("g", 3, out=True), out_quats=f8("g", 4, out=True))
def decompose(covars, out_scales, out_quats):
    """Write the ascending standard deviations of covariances along their axes, and unit quaternions of these axes.

    The quaternions are wxyz with w >= 0.
    """
