"""What networks read of groups besides their moments, where the members of earlier batches are gone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmerge.networks.apply import NetworkContext
from gsmerge.networks.tokens import GroupFeatures
from gsmerge.online.state import ViewSamples
from gsmerge.types import FeatureGaussians


@dataclass(frozen=True, eq=False, kw_only=True)
class StateContext(NetworkContext):
    """The networks for groups of a batch, and of a state, whose ``cameras`` are those of all views.

    Rows in the place of members name the parts that a Feature Gaussian was pooled from: Gaussians of the batch, or
    groups.
    """

    samples: ViewSamples  # Of all views
    part_views: np.ndarray  # [p] int64, the view of each part
    part_members: np.ndarray  # [p] int64, Gaussians that became the part
    part_weights: np.ndarray  # [p] sum of their opacities

    def describe(self, features: FeatureGaussians) -> GroupFeatures:
        """Compute the networks' inputs for Feature Gaussians."""
        return self.samples.describe(features, *self.facts(features), self.cameras)

    def facts(self, features: FeatureGaussians) -> tuple[np.ndarray, np.ndarray]:
        """Return the view that most of each Feature Gaussian belongs to, by weight, and the number of its members."""
        starts, rows = features.starts, features.members
        owners = np.repeat(np.arange(len(features)), np.diff(starts))
        keys, places = np.unique(owners * len(self.cameras) + self.part_views[rows], return_inverse=True)
        of_keys, sums = keys // len(self.cameras), np.bincount(places, self.part_weights[rows])
        order = np.lexsort((keys, -sums, of_keys))
        _, first = np.unique(of_keys[order], return_index=True)
        num_members = np.bincount(owners, self.part_members[rows], len(features))
        return keys[order[first]] % len(self.cameras), num_members.astype(np.int64)
