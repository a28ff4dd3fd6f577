"""What early training is held by: the analytic result as a teacher, and children that stay apart (paper sec. 4.6)."""

from __future__ import annotations

import torch
from torch import Tensor

from gsmerge.geometry import quat_to_rotmat
from gsmerge.networks.residuals import ROTATION
from gsmerge.types import Gaussians

GOAL = 0.5  # overlap of boxes that children are drawn to
GEOMETRY, OPACITY = 0.75, 0.25  # shares of the two terms of the diversification


def teacher_loss(corrections: Tensor) -> Tensor:
    """Distance from the analytic Gaussians: the angle of the rotation, and L1 of everything else.

    The analytic ones are the moment-matched teacher of the paper; corrections are the difference to it, in sizes of
    the Gaussian, logarithms and logits. The length of a rotation vector is the geodesic distance of the quaternions.

    Args:
        corrections: ``[n,13]``.
    """
    if len(corrections) == 0:
        return corrections.new_zeros(())
    rest = torch.cat([corrections[:, : ROTATION.start], corrections[:, ROTATION.stop :]], 1)
    return corrections[:, ROTATION].norm(dim=1).mean() + rest.abs().mean()


def diversity_loss(gaussians: Gaussians, parents: Tensor) -> Tensor:
    """Pairs of children that overlap too much, too little, or of which one is much more opaque (paper supplement).

    Pairs count by their volumes. Those are divided by their mean over all pairs, and held fixed: otherwise the loss
    would hang on the scale of the world, and shrinking would be the easiest way to lower it.

    Args:
        gaussians: n children, those of one group next to each other.
        parents: ``[n]`` the group of each.
    """
    one, other = sibling_pairs(parents)
    if len(one) == 0:
        return gaussians.means.new_zeros(())
    volumes = gaussians.scales.detach().prod(1)
    weights = (volumes[one] * volumes[other]).sqrt()
    weights = weights / weights.mean().clamp_min(1e-30)
    profile = overlap_profile(gaussians, one, other)
    opacity = (gaussians.opacities[one] - gaussians.opacities[other]).square()
    return (weights * (GEOMETRY * profile + OPACITY * opacity)).mean()


def sibling_pairs(parents: Tensor) -> tuple[Tensor, Tensor]:
    """Rows of all pairs of children with the same parent, each once."""
    most = int(torch.bincount(parents).max()) if len(parents) else 0
    rows = torch.arange(len(parents))
    found = [rows[: len(rows) - gap][parents[: len(rows) - gap] == parents[gap:]] for gap in range(1, most)]
    gaps = [torch.full_like(first, gap) for gap, first in enumerate(found, 1)]
    empty = rows[:0]
    one = torch.cat([empty, *found])
    return one, one + torch.cat([empty, *gaps])


def overlap_profile(gaussians: Gaussians, one: Tensor, other: Tensor) -> Tensor:
    """``[p]`` the paper's U-shaped profile of pairs: 0 where their boxes overlap by half.

    Boxes are those of one standard deviation along the world's axes, as in matching.
    """
    axes = quat_to_rotmat(gaussians.quats) * gaussians.scales[:, None]
    halves = axes.norm(dim=2)
    away = (gaussians.means[one] - gaussians.means[other]).abs()
    a, b = halves[one], halves[other]
    shared = torch.minimum(torch.minimum(a + b - away, 2 * a), 2 * b).clamp_min(0).prod(1)
    union = (8 * a.prod(1) + 8 * b.prod(1) - shared).clamp_min(1e-30)
    overlaps = shared / union
    contact = (a.norm(dim=1) + b.norm(dim=1)).clamp_min(1e-12)
    gaps = (away.norm(dim=1) - contact).clamp_min(0) / contact
    apart = 0.5 * ((GOAL - overlaps) / GOAL) ** 3 + 0.5 * (1 - torch.exp(-3 * gaps))
    return torch.where(overlaps >= GOAL, ((overlaps - GOAL) / (1 - GOAL)) ** 3, apart)
