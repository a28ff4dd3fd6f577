"""feature gaussians -> feature gaussians: each in line with its neighbours, where networks are loaded."""

from __future__ import annotations

from gsmerge.networks import NetworkContext, refine_features
from gsmerge.types import FeatureGaussians


def refine(features: FeatureGaussians, learned: NetworkContext | None) -> FeatureGaussians:
    """Feature Gaussians with the refiner's corrections (paper section 4.5); as they are without networks.

    Args:
        features: Merged Feature Gaussians of all views.
        learned: Networks and the scene, or None.
    """
    return features if learned is None else refine_features(features, learned)
