"""Let networks correct the results of the analytic stages, which are the stages that use closed formulas."""

from __future__ import annotations

import numpy as np

from gsmerge.settings.stages import MAX_CHILDREN
from gsmerge.types import FeatureGaussians, Gaussians


class Corrector:
    """Interface of corrections. This base class returns everything unchanged, for runs without networks.

    The subclass with networks is :class:`gsmerge.method.networks.apply.NetworkContext`.
    """

    @property
    def max_children(self) -> int:
        """Largest number of children that a Feature Gaussian may have."""
        return MAX_CHILDREN

    def encode(self, features: FeatureGaussians) -> FeatureGaussians:
        """Return pooled Feature Gaussians with corrections and latents."""
        return features

    def merge(
        self, pooled: FeatureGaussians, parts: FeatureGaussians, order: np.ndarray, cuts: np.ndarray
    ) -> FeatureGaussians:
        """Return merged Feature Gaussians with corrections.

        Each row of ``pooled`` is a cluster of rows of ``parts``. The rows of a cluster are adjacent in ``order``, and
        ``cuts`` are the positions in ``order`` at which clusters begin.
        """
        return pooled

    def refine(self, features: FeatureGaussians) -> FeatureGaussians:
        """Return merged Feature Gaussians with corrections that depend on their neighbours."""
        return features

    @property
    def makes_children(self) -> bool:
        """True if :meth:`decode` makes all children itself, so that a group may have more children than members."""
        return False

    def decode(self, children: Gaussians, parents: np.ndarray, features: FeatureGaussians) -> Gaussians:
        """Return the children of Feature Gaussians with corrections.

        ``parents [n]`` are the rows of the children's Feature Gaussians in ``features``, ascending.
        """
        return children


ANALYTIC = Corrector()  # for runs without networks
