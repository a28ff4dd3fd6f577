"""groups -> feature gaussians, on a device: the moments of every group, as the kernel ``pool`` has them."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from itertools import pairwise

import torch
from torch import Tensor

from gsmerge.gpu.runs import Rows, middle_of_runs, owners_of, sum_runs
from gsmerge.gpu.scene import DeviceMembers, Features
from gsmerge.kernels.gaussians.pool import CAP, FLOOR, MAX_OPACITY
from gsmerge.networks.residuals import quat_to_rotmat

ENTRIES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # of a symmetric matrix
AT_ONCE = 1 << 21  # members that are pooled at once: about 1 GB of float64 columns


@dataclass(frozen=True, eq=False)
class Moments:
    """Pooled moments of g groups, float64, sh float32; fields and shapes as of :class:`gsmerge.moments.Moments`."""

    means: Tensor
    covars: Tensor
    weights: Tensor
    masses: Tensor
    extinctions: Tensor
    footprints: Tensor
    sh: Tensor


def pool_members(members: DeviceMembers, starts: Tensor, ids: Tensor) -> Moments:
    """Moments of every group of members: opacity weights, total covariance, winsorised members; rule ``"depth"``.

    Args:
        members: The scene's Gaussians.
        starts: ``[g+1]`` int64 into ``ids``; no group is empty.
        ids: ``[m]`` int64 rows of ``members``.
    """
    cuts = [0, len(starts) - 1]
    if len(ids) > AT_ONCE:
        firsts = torch.arange(0, len(ids), AT_ONCE, device=ids.device)
        cuts = sorted({*torch.searchsorted(starts[:-1].contiguous(), firsts).tolist(), cuts[1]})
    parts = []
    for first, last in pairwise(cuts):
        own = starts[first : last + 1]
        rows = ids if len(cuts) == 2 else ids[int(own[0]) : int(own[-1])]
        parts.append(_pool(members, own - own[:1], rows))
    return Moments(*(torch.cat([getattr(part, f.name) for part in parts]) for f in fields(Moments)))


def _pool(members: DeviceMembers, starts: Tensor, ids: Tensor) -> Moments:
    owners, sizes, g = owners_of(starts, len(ids)), starts[1:] - starts[:-1], members.gaussians
    opacities = g.opacities[ids].double().clamp_max(MAX_OPACITY)
    weights = sum_runs(opacities, starts)
    # a fully transparent group still has a place and a colour
    shares = torch.where((weights > 0)[owners], opacities / weights[owners], 1 / sizes[owners].double())
    scales = g.scales[ids].double() * member_caps(members, starts, ids, owners)[:, None]
    own_means = g.means[ids].double()
    colors = torch.cat([g.sh0[ids], g.shN[ids]], 1).reshape(len(ids), -1)
    firsts = torch.cat([own_means, members.footprints[ids].double()[:, None], colors.double()], 1)
    averages = sum_runs(shares[:, None] * firsts, starts)
    means, footprints = averages[:, :3], averages[:, 3]
    delta = own_means - means[owners]
    half = quat_to_rotmat(_no_zero(g.quats[ids].double())) * scales[:, None]
    spread = torch.stack(
        [shares * (delta[:, i] * delta[:, j] + (half[:, i] * half[:, j]).sum(1)) for i, j in ENTRIES], 1
    )
    pairs = torch.stack([scales[:, 0] * scales[:, 1], scales[:, 0] * scales[:, 2], scales[:, 1] * scales[:, 2]], 1)
    extinctions = -torch.log1p(-opacities) * pairs.amax(1)
    sums = sum_runs(torch.cat([spread, (opacities * scales.prod(1))[:, None], extinctions[:, None]], 1), starts)
    xx, xy, xz, yy, yz, zz = sums[:, :6].unbind(1)
    floor = torch.eye(3, dtype=torch.float64, device=ids.device) * ((FLOOR * footprints) ** 2)[:, None, None]
    return Moments(
        means=means,
        covars=torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], 1).reshape(-1, 3, 3) + floor,
        weights=weights,
        masses=(2 * math.pi) ** 1.5 * sums[:, 6],
        extinctions=sums[:, 7],
        footprints=footprints,
        sh=averages[:, 4:].reshape(len(means), -1, 3).float(),
    )


def _no_zero(quats: Tensor) -> Tensor:
    """Quaternions with the identity in place of those of length zero."""
    identity = torch.tensor([1.0, 0, 0, 0], dtype=quats.dtype, device=quats.device)
    return torch.where((quats != 0).any(1, keepdim=True), quats, identity)


def member_caps(members: DeviceMembers, starts: Tensor, ids: Tensor, owners: Tensor) -> Tensor:
    """``[m]`` shrink factor of each member: at most ``CAP`` times the median extent of its group, in footprints."""
    extents = members.gaussians.scales[ids].amax(1) / members.footprints[ids]
    limits = CAP * middle_of_runs(extents, starts, owners).double()
    return torch.where(extents > limits[owners], limits[owners] / extents, 1.0)


def encode(members: DeviceMembers, rows: Rows, views: Tensor) -> Features:
    """One Feature Gaussian per superpixel, as :func:`gsmerge.stages.encode.encode` with the rule ``"depth"``.

    Args:
        members: The scene's Gaussians.
        rows: Members by superpixel.
        views: ``[g]`` int64 the view of each.
    """
    moments = pool_members(members, rows.starts, rows.ids)
    ones = torch.ones(len(rows), device=views.device)
    return Features(
        means=moments.means.float(),
        covars=moments.covars.float(),
        weights=moments.weights.float(),
        masses=moments.masses.float(),
        extinctions=moments.extinctions.float(),
        gains=ones,
        spreads=ones,
        sh0=moments.sh[:, :1],
        shN=moments.sh[:, 1:],
        footprints=moments.footprints.float(),
        views=views,
        backing=torch.zeros(len(rows), dtype=torch.bool, device=views.device),
        starts=rows.starts,
        members=rows.ids,
    )
