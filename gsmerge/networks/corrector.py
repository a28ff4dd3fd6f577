"""Interface of corrections to the analytic stages; :class:`gsmerge.networks.apply.NetworkContext` has networks."""

from __future__ import annotations

import numpy as np

from gsmerge.settings.stages import MAX_CHILDREN
from gsmerge.types import FeatureGaussians, Gaussians


class Corrector:
    """Correct nothing: the results of the analytic stages do not change."""

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
        """Correct pooled Feature Gaussians; ``cuts`` are the starts of their runs in ``order``, rows of ``parts``."""
        return pooled

    def refine(self, features: FeatureGaussians) -> FeatureGaussians:
        """Correct merged Feature Gaussians by their neighbours."""
        return features

    @property
    def makes_children(self) -> bool:
        """True if :meth:`decode` makes children without analytic ones, so that every group can have any number."""
        return False

    def decode(self, children: Gaussians, parents: np.ndarray, features: FeatureGaussians) -> Gaussians:
        """Correct the children of Feature Gaussians; ``parents [n]`` are rows of ``features``, ascending."""
        return children


ANALYTIC = Corrector()
