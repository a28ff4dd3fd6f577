"""feature gaussians -> gaussians: K children of every group, analytic, with the networks' heads on top."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from gsmerge.kernels.gaussians.bisect import bisect, gather_groups
from gsmerge.moments import Members, Rule, feature_to_gaussians, pool_members, to_gaussians
from gsmerge.networks import NetworkContext, decode_gaussians
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import FeatureGaussians, Gaussians

MAX_CHILDREN = 8
GROUPS_PER_TASK = 8192


@dataclass(frozen=True)
class DecodeOptions:
    """How many Gaussians a Feature Gaussian becomes.

    Args:
        k: Children of each group, 1 to 8; ``"auto"``: one, of groups that follow what the scene needs.
        min_opacity: Gaussians below this opacity are left out (paper section 4.3).

    Raises:
        ValueError: If K is not within 1 to 8 or the opacity not within 0 to 1.
    """

    k: int | Literal["auto"] = 1
    min_opacity: float = 1 / 255

    def __post_init__(self) -> None:
        if self.k != "auto" and not (isinstance(self.k, int) and 1 <= self.k <= MAX_CHILDREN):
            raise ValueError(f'k: expected 1 to {MAX_CHILDREN} or "auto", got {self.k!r}')
        if not 0 <= self.min_opacity <= 1:
            raise ValueError(f"min_opacity: expected 0 to 1, got {self.min_opacity}")

    @property
    def count(self) -> int:
        """Children of each group as a number."""
        return 1 if self.k == "auto" else self.k


def decode(
    features: FeatureGaussians,
    members: Members,
    options: DecodeOptions,
    counts: np.ndarray | None = None,
    rule: Rule = "depth",
    learned: NetworkContext | None = None,
) -> Gaussians:
    """K Gaussians for each Feature Gaussian, fewer where its members are alike; the backing layer stays at one.

    Children are found by halving the members again and again across their widest direction in colour and
    position, so that those of K = 2 are unions of those of K = 4, and are pooled by the encoder's rule.

    Args:
        features: The Feature Gaussians; at K > 1 their members are looked up again.
        members: The scene's Gaussians that ``features.members`` points into.
        options: K and the least opacity.
        counts: ``[g]`` a K for every group instead, from 1 on; those of the backing layer are not looked at.
        rule: How children are pooled, the encoder's.
        learned: Networks whose heads correct the children; None: none does.

    Returns:
        The Gaussians, those of one group next to each other.

    Raises:
        ValueError: If ``counts`` has the wrong shape or a count below 1.
    """
    if counts is None:
        counts = np.full(len(features), options.count)
    if counts.shape != (len(features),) or counts.min(initial=1) < 1:
        raise ValueError(f"counts: expected {len(features)} numbers from 1 on, got shape {list(counts.shape)}")
    gaussians, parents = divide(features, members, counts, rule)
    if learned is not None:
        gaussians = decode_gaussians(gaussians, parents, features, learned)
    return gaussians[gaussians.opacities >= options.min_opacity]


def divide(
    features: FeatureGaussians, members: Members, counts: np.ndarray, rule: Rule = "depth"
) -> tuple[Gaussians, np.ndarray]:
    """The analytic children of :func:`decode`, however faint, and the Feature Gaussian ``[n]`` of each, rising."""
    divided = (counts > 1) & ~features.backing.numpy()
    gaussians, parents = feature_to_gaussians(features), np.arange(len(features))
    if divided.any():
        children, of_children = _children(features, members, np.flatnonzero(divided), counts, rule)
        whole = np.flatnonzero(~divided)
        parents = np.concatenate([whole, of_children])
        order = np.argsort(parents, kind="stable")
        parents = parents[order]
        gaussians = Gaussians.concat([gaussians[torch.from_numpy(whole)], children])[torch.from_numpy(order)]
    return gaussians, parents


def _children(
    features: FeatureGaussians, members: Members, groups: np.ndarray, counts: np.ndarray, rule: Rule
) -> tuple[Gaussians, np.ndarray]:
    """Gaussians of the children of some groups, and the group of each."""
    starts, ids, parents = halve(features, members, groups, counts)
    return pool_children(features, members, starts, ids, parents, rule), parents


def halve(
    features: FeatureGaussians, members: Members, groups: np.ndarray, counts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Members of the children of some groups: ``starts [n+1]`` into the rows ``[m]``, and the group of each child.

    Args:
        features: All g Feature Gaussians.
        members: The scene's Gaussians.
        groups: The Feature Gaussians to divide.
        counts: ``[g]`` most children of each.
    """
    starts, ids = features.starts.numpy(), features.members.numpy()
    centres, footprints = features.means.double().numpy(), features.footprints.double().numpy()

    def run(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        local, own = gather_groups(starts, ids, rows)
        m = members
        child_starts, child_ids, parents = bisect(
            local, own, m.means, m.sh0, m.opacities, centres[rows], footprints[rows], counts[rows]
        )
        return np.diff(child_starts), child_ids, rows[parents]

    found = parallel_map(run, [groups[i : i + GROUPS_PER_TASK] for i in range(0, len(groups), GROUPS_PER_TASK)])
    sizes, child_ids, parents = (np.concatenate(column) for column in zip(*found, strict=True))
    return np.concatenate([[0], np.cumsum(sizes)]), child_ids, parents


def pool_children(
    features: FeatureGaussians, members: Members, starts: np.ndarray, ids: np.ndarray, parents: np.ndarray, rule: Rule
) -> Gaussians:
    """One Gaussian for each run of members, with gain and spread of the Feature Gaussian that it is a child of."""
    moments = pool_members(members, starts, ids, rule)
    gains, spreads = features.gains.double().numpy()[parents], features.spreads.double().numpy()[parents]
    means, sh = torch.from_numpy(moments.means), torch.from_numpy(moments.sh)
    return to_gaussians(moments.covars, moments.extinctions * gains, spreads, means, sh)
