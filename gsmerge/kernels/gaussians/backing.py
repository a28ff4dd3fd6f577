"""Members seen from their own view: depths drawn in to the group's, optical depth over image areas."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.gaussians.pool import MAX_OPACITY, _member_caps, _rotation
from gsmerge.kernels.gaussians.select import partition
from gsmerge.kernels.jit import kernel


@kernel
def draw_in(starts, ids, inverse_depths, pixel, out):
    """Factor on the distance from the camera that brings each member within one group footprint of the median depth.

    ``inverse_depths [n]``; ``pixel``: angle of one pixel; a group of n members spans about sqrt(n) pixels.
    """
    longest = 0
    for g in range(starts.shape[0] - 1):
        longest = max(longest, starts[g + 1] - starts[g])
    order = np.empty(longest, np.int64)
    for g in range(starts.shape[0] - 1):
        n = starts[g + 1] - starts[g]
        if n == 0:
            continue
        for j in range(n):
            order[j] = ids[starts[g] + j]
        partition(inverse_depths, order, 0, n, n // 2)
        middle = inverse_depths[order[n // 2]]
        reach = min(pixel * np.sqrt(n), 0.9)
        for j in range(n):
            i = ids[starts[g] + j]
            drawn = middle * (1 + min(max(inverse_depths[i] / middle - 1, -reach), reach))
            out[i] = inverse_depths[i] / drawn


@kernel
def image_extinctions(starts, ids, means, quats, scales, opacities, footprints, viewmat, fx, fy, out):
    """Sum over each group of the members' optical depth times their area in the source image, square pixels."""
    longest = 0
    for g in range(starts.shape[0] - 1):
        longest = max(longest, starts[g + 1] - starts[g])
    caps, order = np.empty(longest), np.empty(longest, np.int64)
    r = viewmat[:3, :3]
    for g in range(starts.shape[0] - 1):
        members = ids[starts[g] : starts[g + 1]]
        if members.shape[0] == 0:
            continue
        _member_caps(members, scales, footprints, caps, order)
        total = 0.0
        for j in range(members.shape[0]):
            i = members[j]
            x = r[0, 0] * means[i, 0] + r[0, 1] * means[i, 1] + r[0, 2] * means[i, 2] + viewmat[0, 3]
            y = r[1, 0] * means[i, 0] + r[1, 1] * means[i, 1] + r[1, 2] * means[i, 2] + viewmat[1, 3]
            z = r[2, 0] * means[i, 0] + r[2, 1] * means[i, 1] + r[2, 2] * means[i, 2] + viewmat[2, 3]
            z = max(z, 1e-9)
            q = _rotation(quats[i])
            uu, uv, vv = 0.0, 0.0, 0.0
            for k in range(3):
                ax, ay, az = q[k], q[3 + k], q[6 + k]
                s = caps[j] * scales[i, k] / z
                cz = (r[2, 0] * ax + r[2, 1] * ay + r[2, 2] * az) * s
                u = fx * ((r[0, 0] * ax + r[0, 1] * ay + r[0, 2] * az) * s - x / z * cz)
                v = fy * ((r[1, 0] * ax + r[1, 1] * ay + r[1, 2] * az) * s - y / z * cz)
                uu += u * u
                uv += u * v
                vv += v * v
            area = np.sqrt(max(uu * vv - uv * uv, 0.0))
            total -= np.log(1.0 - min(opacities[i], MAX_OPACITY)) * area
        out[g] = total
