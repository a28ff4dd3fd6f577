"""Agreement of the views' depths: fainter starts for disputed groups, and a share of superpixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.moments import Members, scene_members
from gsmerge.networks.cross_view_stats import cross_view_stats
from gsmerge.runtime.record import choose
from gsmerge.types import Cameras, FeatureGaussians, Scene

# Factors on the optical depth of groups that other views see through: those at whose place no other view has its
# surface, and those of which fewer views have it there than see through it
ALONE, DISPUTED = 0.15, 0.39
SAMPLES = 65536  # pixels whose depths are compared
# Superpixels per pixel: most, where all depths agree, falling to the fewest as those that other views see through come
# near this part of all. More of them repeat what is wrong, and are learned by heart (nine training captures).
MOST, FEWEST, WRONG = 0.08, 0.015, 0.38


def measured_share(scene: Scene) -> tuple[float | None, str]:
    """Choose superpixels per pixel by the agreement of the views' depths, None if unknown; and say why."""
    if not scene.aligned or len(scene) < 2:
        return None, "depths of several views cannot be compared"
    wrong = contradicted_share(scene, scene_members(scene))
    share = min(MOST, max(FEWEST, MOST * (1 - wrong / WRONG)))
    choose(superpixels={"share": share, "contradicted": wrong})
    return share, f"other views see through {100 * wrong:.0f} % of the pixels"


def contradicted_share(scene: Scene, members: Members) -> float:
    """Return the share of sampled valid pixels that more views see through than have a surface there."""
    rows = np.flatnonzero(scene.valid)
    rows = rows[:: max(1, len(rows) // SAMPLES)]
    views = rows // scene.pixels_per_view
    factors = agreement_factors(members.means[rows], scene.gaussians.sh0[rows], views, members, scene.cameras)
    return float((factors < 1).mean()) if len(rows) else 0.0


def weaken_contradicted(features: FeatureGaussians, members: Members, cameras: Cameras) -> FeatureGaussians:
    """Lower the optical depth of single-view groups that other views see through."""
    factors = agreement_factors(features.means, features.sh0, features.views, members, cameras)
    return replace(features, gains=features.gains * factors)


def agreement_factors(
    means: np.ndarray, sh0: np.ndarray, views: np.ndarray, members: Members, cameras: Cameras
) -> np.ndarray:
    """Return the factor ``[g]`` float32, at most 1, on the optical depth of each point.

    Arguments are those of :func:`gsmerge.networks.cross_view_stats.cross_view_stats`; unaligned
    scenes get ones.
    """
    _, same, behind, *_ = cross_view_stats(means, sh0, views, members, cameras).T
    disputed = np.where(same > 0, DISPUTED, ALONE)
    return np.where(behind > same, disputed, 1).astype(np.float32)
