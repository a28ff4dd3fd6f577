"""Sort members into groups, split groups into children, and compute moments, scales and rotations of groups.

A group is split by halving its members repeatedly across their widest direction.
"""

from __future__ import annotations

import numpy as np

from gsmerge.method.kernels.signature import STATUS, declare, f4, f8, i4, i8, native

_sort_labels = declare("sort_labels", STATUS, labels=i4("n"), starts=i8("ends", out=True), ids=i4("n", out=True))


def group_members(labels, count):
    """Sort members by label.

    Returns the start ``[count+1]`` int64 of each label in a list of rows, and this int32 list. Members with labels
    below 0 are left out.

    Args:
        labels: ``[n]`` int32, below ``count``.
        count: Number of labels.
    """
    starts = np.empty(count + 1, np.int64)
    ids = np.empty(len(labels), np.int32)
    _sort_labels(labels, starts, ids)
    return starts, ids[: starts[-1]]


# `features` to `room` are work space for the longest group and the most children. `errors` may have no columns
_split_groups = declare(
    "split_groups", STATUS, starts=i8("ends", least=0, ascending=True), ids=i4("m"), means=f4("n", 3),
    sh0=f4("n", 1, 3), opacities=f4("n"), centres=f8("groups", 3), footprints=f8("groups"),
    counts=i8("groups", least=1), plane_weight=f8(), features=f8("longest", 8, out=True),
    weights=f8("longest", out=True), order=i8(2, "longest", out=True), cuts=i8("bounds", out=True),
    room=f8("most", 18, out=True), child_starts=i8("slots", out=True), child_ids=i4("own", out=True),
    parents=i8("children", out=True), num_children=i8(1, out=True), errors=f8("groups", "width", out=True),
)  # fmt: skip


def gather_groups(starts, ids, rows):
    """Return the starts ``[r+1]`` and the ids of the members of the groups ``rows [r]``, group after group."""
    sizes = starts[rows + 1] - starts[rows]
    row_starts = np.concatenate([[0], np.cumsum(sizes)])
    positions = (starts[rows] - row_starts[:-1]).astype(np.int32).repeat(sizes)  # in `ids`
    positions += np.arange(row_starts[-1], dtype=np.int32)
    return row_starts, ids[positions]


def bisect(starts, ids, means, sh0, opacities, centres, footprints, num_children):
    """Divide the members of every group into ``num_children`` children, by halving.

    ``num_children`` is one number for all groups or ``[g]``, at least 1. In each step, the child with the largest
    spread of features is halved. The features of a member are its colour, and its position relative to ``centres
    [g,3]`` in units of ``footprints [g]``. A group gives fewer children if members have equal features, because a child
    of equal members cannot be halved. If a group is halved into two children, they are unions of the four children into
    which it can be divided.

    Returns the start ``[m+1]`` of each child in a list of members, the list itself, and the group ``[m]`` of each
    child.
    """
    num_groups = len(starts) - 1
    counts = np.array(np.broadcast_to(num_children, num_groups), np.int64)
    return _split_into_children(
        starts, ids, means, sh0, opacities, centres, footprints, counts, np.empty((num_groups, 0)), 0.0
    )


def split_errors(starts, ids, means, sh0, opacities, centres, footprints, max_children, plane_weight):
    """Return the squared error ``[g,max_children]`` of every group with 1, 2 and more children of :func:`bisect`.

    The error is NaN for more children than a group can have. The error of a group is the weighted sum of the errors of
    its members. The error of a member is its squared distance from the child's mean colour, plus ``plane_weight`` times
    its squared distance from a plane through the child, both in features. The mean weight of the members is one, and
    opaque members weigh more.
    """
    num_groups = len(starts) - 1
    counts = np.full(num_groups, max_children, np.int64)
    errors = np.full((num_groups, max_children), np.nan)
    _split_into_children(starts, ids, means, sh0, opacities, centres, footprints, counts, errors, plane_weight)
    return errors


def _split_into_children(starts, ids, means, sh0, opacities, centres, footprints, counts, errors, plane_weight):
    """Return the result of :func:`bisect`, and write an error for each number of children to ``errors [g, any]``."""
    sizes = np.diff(starts)
    counts = np.minimum(counts, np.maximum(sizes, 1))
    longest = int(sizes.max(initial=0))
    most = int(counts.max(initial=1))
    total = int(counts.sum())
    child_starts = np.empty(total + 1, np.int64)
    parents = np.empty(total, np.int64)
    child_ids = np.empty(starts[-1] - starts[0], np.int32)
    num_children = np.empty(1, np.int64)
    _split_groups(
        starts, np.asarray(ids, np.int32), means, sh0, opacities, centres, footprints, counts, plane_weight,
        np.empty((longest, 8)), np.empty(longest), np.empty((2, longest), np.int64), np.empty(most + 1, np.int64),
        np.empty((most, 18)), child_starts, child_ids, parents, num_children, errors,
    )  # fmt: skip
    count = int(num_children[0])
    return child_starts[: count + 1].copy(), child_ids, parents[:count].copy()


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
