"""What corrects the analytic stages: nothing here, networks in :class:`gsmerge.networks.apply.NetworkContext`."""

from __future__ import annotations

import numpy as np

from gsmerge.settings.stages import MAX_CHILDREN
from gsmerge.types import FeatureGaussians, Gaussians


class Corrector:
    """The closed formulas alone: every stage's result stays as it is."""

    @property
    def max_children(self) -> int:
        """Largest number of children of a Feature Gaussian."""
        return MAX_CHILDREN

    def encode(self, features: FeatureGaussians) -> FeatureGaussians:
        """Correct pooled Feature Gaussians and add their latents."""
        return features

    def merge(
        self, pooled: FeatureGaussians, parts: FeatureGaussians, order: np.ndarray, cuts: np.ndarray
    ) -> FeatureGaussians:
        """Correct Feature Gaussians pooled from the rows ``order`` of ``parts``, in runs from ``cuts``."""
        return pooled

    def refine(self, features: FeatureGaussians) -> FeatureGaussians:
        """Correct merged Feature Gaussians by their neighbours."""
        return features

    @property
    def makes_children(self) -> bool:
        """Whether :meth:`decode` makes children of nothing, so that every group can have any number of them."""
        return False

    def decode(self, children: Gaussians, parents: np.ndarray, features: FeatureGaussians) -> Gaussians:
        """Correct the children of Feature Gaussians; ``parents [n]`` are rows of ``features``, ascending."""
        return children


ANALYTIC = Corrector()
