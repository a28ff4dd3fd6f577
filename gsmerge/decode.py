"""feature gaussians -> gaussians: K children of every group, without a network."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gsmerge.kernels.bisect import bisect
from gsmerge.moments import Members, feature_to_gaussians, pool_members, to_gaussians
from gsmerge.threads import parallel_map
from gsmerge.types import FeatureGaussians, Gaussians

MAX_CHILDREN = 8
GROUPS_PER_TASK = 8192


@dataclass(frozen=True)
class DecodeOptions:
    """How many Gaussians a Feature Gaussian becomes.

    Args:
        k: Children of each group, 1 to 8.
        min_opacity: Gaussians below this opacity are left out (paper section 4.3).
    """

    k: int = 1
    min_opacity: float = 1 / 255


def decode(features: FeatureGaussians, members: Members, options: DecodeOptions) -> Gaussians:
    """K Gaussians for each Feature Gaussian, fewer where its members are alike; the backing layer stays at one.

    Children are found by halving the members again and again across their widest direction in colour and
    position, so that those of K = 2 are unions of those of K = 4, and are pooled by the encoder's rule.

    Args:
        features: The Feature Gaussians; at K > 1 their members are looked up again.
        members: The scene's Gaussians that ``features.members`` points into.
        options: K and the least opacity.

    Returns:
        The Gaussians, those of one group next to each other.

    Raises:
        ValueError: If K is not within 1 to 8.
    """
    if not 1 <= options.k <= MAX_CHILDREN:
        raise ValueError(f"k: expected 1 to {MAX_CHILDREN}, got {options.k}")
    if options.k == 1:
        gaussians = feature_to_gaussians(features)
    else:
        backing = features.backing
        parts = [_children(features, members, options.k)]
        if bool(backing.any()):
            parts.append(feature_to_gaussians(features)[backing])
        gaussians = Gaussians.concat(parts)
    return gaussians[gaussians.opacities >= options.min_opacity]


def _children(features: FeatureGaussians, members: Members, count: int) -> Gaussians:
    """Gaussians of the children of all groups in front."""
    front = torch.nonzero(~features.backing)[:, 0].numpy()
    starts, ids = features.starts.numpy(), features.members.numpy()
    centres, footprints = features.means.double().numpy(), features.footprints.double().numpy()

    def run(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        # groups in front are contiguous in the rows of one task unless the backing layer lies between
        sizes = starts[rows + 1] - starts[rows]
        local = np.concatenate([[0], np.cumsum(sizes)])
        own = ids[np.repeat(starts[rows] - local[:-1], sizes) + np.arange(local[-1])]
        child_starts, child_ids, parents = bisect(
            local, own, members.means, members.sh, members.opacities, centres[rows], footprints[rows], count
        )
        return np.diff(child_starts), child_ids, rows[parents]

    tasks = [front[i : i + GROUPS_PER_TASK] for i in range(0, len(front), GROUPS_PER_TASK)]
    found = parallel_map(run, tasks)
    sizes, child_ids, parents = (np.concatenate(column) for column in zip(*found, strict=True))
    moments = pool_members(members, np.concatenate([[0], np.cumsum(sizes)]), child_ids)
    gains, spreads = features.gains.double().numpy()[parents], features.spreads.double().numpy()[parents]
    means, sh = torch.from_numpy(moments.means), torch.from_numpy(moments.sh)
    return to_gaussians(moments.covars, moments.extinctions * gains, spreads, means, sh)
