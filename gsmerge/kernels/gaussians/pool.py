"""Group members together and replace each group by the Gaussian with the same moments."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.gaussians.select import partition
from gsmerge.kernels.jit import kernel

MAX_OPACITY = 0.995  # optical depth of a member is -ln(1 - opacity); 1 would be infinite
CAP = 3.0  # members are shrunk to this many times the group's median extent
FLOOR = 0.1  # smallest standard deviation of a group, in pixel footprints


@kernel
def group_members(labels, count):
    """Counting sort: ``starts [count+1]`` and member ids by label, in rising order; labels below 0 are left out."""
    starts = np.zeros(count + 1, np.int64)
    for i in range(labels.shape[0]):
        if labels[i] >= 0:
            starts[labels[i] + 1] += 1
    for g in range(count):
        starts[g + 1] += starts[g]
    ids = np.empty(starts[count], np.int64)
    fill = starts[:-1].copy()
    for i in range(labels.shape[0]):
        g = labels[i]
        if g >= 0:
            ids[fill[g]] = i
            fill[g] += 1
    return starts, ids


@kernel
def _largest(a, b, c):
    return max(a, b, c)


@kernel
def _two_largest_product(a, b, c):
    return max(a * b, a * c, b * c)


@kernel
def _member_caps(ids, scales, footprints, caps, order):
    """Shrink factor of each member: at most CAP times the median extent of the group, extents in footprints.

    ``caps`` and ``order``, float64 and int64 of at least the group's length, are written.
    """
    n = ids.shape[0]
    for j in range(n):
        i = ids[j]
        caps[j] = _largest(scales[i, 0], scales[i, 1], scales[i, 2]) / footprints[i]
        order[j] = j
    middle = (n - 1) // 2  # of two, the smaller one
    partition(caps, order, 0, n, middle)
    limit = CAP * caps[order[middle]]
    for j in range(n):
        caps[j] = limit / caps[j] if caps[j] > limit else 1.0


@kernel
def _rotation(q):
    """Rows of the rotation of a quaternion wxyz of any length; the identity for zero."""
    n = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    s = 2.0 / n if n > 0 else 0.0
    w, x, y, z = q[0], q[1], q[2], q[3]
    return (
        1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
        s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x),
        s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y),
    )  # fmt: skip


@kernel
def pool(starts, ids, means, quats, scales, opacities, sh0, shN, footprints, own_covariance, out_geometry, out_sh):
    """Moments of every group, in float64 about the group's own mean.

    ``out_geometry [g,13]``: mean 3, covariance xx xy xz yy yz zz, sum of opacities, mass (paper eq. mass),
    integrated optical depth (sum of -ln(1 - opacity) x disc area), footprint. ``out_sh [g,k,3]``.
    Without ``own_covariance`` only the spread of the means counts (paper eq. teacher_cov) and nothing is capped.
    """
    longest = 0
    for g in range(starts.shape[0] - 1):
        longest = max(longest, starts[g + 1] - starts[g])
    caps, order = np.empty(longest), np.empty(longest, np.int64)
    for i in range(longest):
        caps[i] = 1.0
    for g in range(starts.shape[0] - 1):
        members = ids[starts[g] : starts[g + 1]]
        if members.shape[0] == 0:
            continue
        if own_covariance:
            _member_caps(members, scales, footprints, caps, order)
        _pool_group(
            members,
            caps,
            means,
            quats,
            scales,
            opacities,
            sh0,
            shN,
            footprints,
            own_covariance,
            out_geometry[g],
            out_sh[g],
        )


@kernel
def _pool_group(members, caps, means, quats, scales, opacities, sh0, shN, footprints, own, out, out_sh):
    total = 0.0
    for i in members:
        total += min(opacities[i], MAX_OPACITY)
    uniform = total <= 0.0  # a fully transparent group still has a place and a colour
    norm = 1.0 / members.shape[0] if uniform else 1.0 / total
    mx, my, mz, footprint = 0.0, 0.0, 0.0, 0.0
    for i in members:
        w = norm if uniform else min(opacities[i], MAX_OPACITY) * norm
        mx += w * means[i, 0]
        my += w * means[i, 1]
        mz += w * means[i, 2]
        footprint += w * footprints[i]
    cxx, cxy, cxz, cyy, cyz, czz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    mass, extinction = 0.0, 0.0
    for j in range(members.shape[0]):
        i = members[j]
        a = min(opacities[i], MAX_OPACITY)
        w = norm if uniform else a * norm
        dx, dy, dz = means[i, 0] - mx, means[i, 1] - my, means[i, 2] - mz
        cxx += w * dx * dx
        cxy += w * dx * dy
        cxz += w * dx * dz
        cyy += w * dy * dy
        cyz += w * dy * dz
        czz += w * dz * dz
        s0, s1, s2 = caps[j] * scales[i, 0], caps[j] * scales[i, 1], caps[j] * scales[i, 2]
        if own:
            r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(quats[i])
            v0, v1, v2 = w * s0 * s0, w * s1 * s1, w * s2 * s2
            cxx += v0 * r00 * r00 + v1 * r01 * r01 + v2 * r02 * r02
            cxy += v0 * r00 * r10 + v1 * r01 * r11 + v2 * r02 * r12
            cxz += v0 * r00 * r20 + v1 * r01 * r21 + v2 * r02 * r22
            cyy += v0 * r10 * r10 + v1 * r11 * r11 + v2 * r12 * r12
            cyz += v0 * r10 * r20 + v1 * r11 * r21 + v2 * r12 * r22
            czz += v0 * r20 * r20 + v1 * r21 * r21 + v2 * r22 * r22
        mass += a * s0 * s1 * s2
        extinction -= np.log(1.0 - a) * _two_largest_product(s0, s1, s2)
        for c in range(3):
            out_sh[0, c] += w * sh0[i, 0, c]
        for k in range(shN.shape[1]):
            for c in range(3):
                out_sh[k + 1, c] += w * shN[i, k, c]
    floor = (FLOOR * footprint) ** 2
    out[0], out[1], out[2] = mx, my, mz
    out[3], out[4], out[5], out[6], out[7], out[8] = cxx + floor, cxy, cxz, cyy + floor, cyz, czz + floor
    out[9], out[10], out[11], out[12] = total, mass * 15.749609945722419, extinction, footprint  # (2 pi)^(3/2)


@kernel
def _rotate_pair(a, u, p, q):
    """One Jacobi rotation of the symmetric 3 x 3 ``a`` that zeroes a[p, q]; ``u`` collects the eigenvectors."""
    if abs(a[p, q]) > 1e-300:
        theta = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
        t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
        t = -t if theta < 0 else t
        c = 1.0 / np.sqrt(t * t + 1.0)
        s = t * c
        for k in range(3):
            x, y = a[k, p], a[k, q]
            a[k, p], a[k, q] = c * x - s * y, s * x + c * y
        for k in range(3):
            x, y = a[p, k], a[q, k]
            a[p, k], a[q, k] = c * x - s * y, s * x + c * y
            x, y = u[k, p], u[k, q]
            u[k, p], u[k, q] = c * x - s * y, s * x + c * y


@kernel(exact=True)
def decompose(covars, out_scales, out_quats):
    """Standard deviations (rising) and unit quaternions wxyz (w >= 0) of covariances ``[g,3,3]``, by Jacobi sweeps."""
    a, u, r, order = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3, np.int64)
    for g in range(covars.shape[0]):
        for i in range(3):
            for j in range(3):
                a[i, j] = covars[g, i, j]
                u[i, j] = 1.0 if i == j else 0.0
        for _ in range(8):
            off = a[0, 1] * a[0, 1] + a[0, 2] * a[0, 2] + a[1, 2] * a[1, 2]
            if off <= 1e-28 * (a[0, 0] * a[0, 0] + a[1, 1] * a[1, 1] + a[2, 2] * a[2, 2]):
                break
            _rotate_pair(a, u, 0, 1)
            _rotate_pair(a, u, 0, 2)
            _rotate_pair(a, u, 1, 2)
        # rising order of the diagonal: the middle one is what the other two leave
        order[0], order[2] = 0, 0
        for k in range(1, 3):
            if a[k, k] < a[order[0], order[0]]:
                order[0] = k
            if a[k, k] >= a[order[2], order[2]]:
                order[2] = k
        order[1] = min(3 - order[0] - order[2], 2)  # NaN compares to nothing
        for k in range(3):
            out_scales[g, k] = np.sqrt(max(a[order[k], order[k]], 0.0))
        for k in range(3):
            for i in range(3):
                r[i, k] = u[i, order[k]]
        _right_handed_quat(r, out_quats[g])


@kernel(exact=True)
def _right_handed_quat(r, out):
    det = (
        r[0, 0] * (r[1, 1] * r[2, 2] - r[1, 2] * r[2, 1])
        - r[0, 1] * (r[1, 0] * r[2, 2] - r[1, 2] * r[2, 0])
        + r[0, 2] * (r[1, 0] * r[2, 1] - r[1, 1] * r[2, 0])
    )
    if det < 0:
        for i in range(3):
            r[i, 0] = -r[i, 0]
    # 4 q q^T has these four diagonals; the largest is the safe one to divide by
    q = np.empty(4)
    q[0] = 1 + r[0, 0] + r[1, 1] + r[2, 2]
    q[1] = 1 + r[0, 0] - r[1, 1] - r[2, 2]
    q[2] = 1 - r[0, 0] + r[1, 1] - r[2, 2]
    q[3] = 1 - r[0, 0] - r[1, 1] + r[2, 2]
    best = 0
    for i in range(1, 4):
        best = i if q[i] > q[best] else best
    big = 0.5 * np.sqrt(q[best])
    f = 0.25 / big
    a, b, c = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    d, e, h = r[1, 0] + r[0, 1], r[0, 2] + r[2, 0], r[2, 1] + r[1, 2]
    if best == 0:
        q[0], q[1], q[2], q[3] = big, a * f, b * f, c * f
    elif best == 1:
        q[0], q[1], q[2], q[3] = a * f, big, d * f, e * f
    elif best == 2:
        q[0], q[1], q[2], q[3] = b * f, d * f, big, h * f
    else:
        q[0], q[1], q[2], q[3] = c * f, e * f, h * f, big
    sign = -1.0 if q[0] < 0 else 1.0
    norm = sign / np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    for i in range(4):
        out[i] = q[i] * norm
