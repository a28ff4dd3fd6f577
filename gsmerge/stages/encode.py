"""Groups -> Feature Gaussians: one per superpixel by closed formulas, corrected by the networks' encoder if any.

Groups start fainter if the depths of the views disagree about them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from gsmerge.geometry.pooling import FOOTPRINT_ROWS, Members, Moments, Rule, pool_members
from gsmerge.kernels.gaussians.pool import group_members
from gsmerge.networks.corrector import ANALYTIC, Corrector
from gsmerge.networks.cross_view_stats import cross_view_stats
from gsmerge.runtime.record import stage
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, FeatureGaussians, Groups, Scene
from gsmerge.values.arrays import to_float32

if TYPE_CHECKING:
    from gsmerge.networks.weights import RunnableNetworks

# Factors on the optical depth of a group if more views see through it than have a surface at its position: ALONE if no
# other view has a surface there, DISPUTED if some do
ALONE, DISPUTED = 0.15, 0.39


def make_corrector(networks: RunnableNetworks | None, members: Members, cameras: Cameras, seed: int) -> Corrector:
    """Combine networks with the members and cameras of a scene; without networks, return the empty correction."""
    if networks is None:
        return ANALYTIC
    from gsmerge.networks.apply import NetworkContext

    return NetworkContext(networks, members, cameras, seed)


@stage("encode")
def encode(scene: Scene, members: Members, groups: Groups, rule: Rule = "depth") -> FeatureGaussians:
    """Pool every superpixel into one Feature Gaussian, in order of view and label.

    Superpixels without a valid member are omitted. ``rule``: see :func:`gsmerge.geometry.pooling.pool_members`.
    """
    starts, ids, views = member_rows(scene, members, groups)
    return from_moments(pool_members(members, starts, ids, rule), starts, ids, views)


@stage("encode")
def correct(
    features: FeatureGaussians, members: Members, cameras: Cameras, networks: Corrector, *, weaken: bool
) -> FeatureGaussians:
    """Correct pooled Feature Gaussians with the encoder network, if any, which also adds latents.

    ``weaken``: lower the optical depth of groups that other views see through. This makes holes, which a long fit
    closes.
    """
    return networks.encode(weaken_contradicted(features, members, cameras) if weaken else features)


def member_rows(scene: Scene, members: Members, groups: Groups) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """List members by superpixel: ``starts [g+1]``, ``ids [m]`` int32, ``views [g]``, without empty superpixels."""
    counts = np.asarray(groups.counts)
    offsets, flat = np.cumsum(counts) - counts, groups.labels.reshape(-1)
    labels = np.empty(len(members.pixels), np.int32)

    def label(start: int) -> None:
        rows = slice(start, start + FOOTPRINT_ROWS)
        pixels = members.pixels[rows]
        labels[rows] = np.where(pixels >= 0, flat[pixels] + offsets[pixels // scene.pixels_per_view], -1)

    parallel_map(label, range(0, len(labels), FOOTPRINT_ROWS))
    starts, ids = group_members(labels, int(counts.sum()))
    sizes = np.diff(starts)
    has_members, views = sizes > 0, np.repeat(np.arange(len(scene)), groups.counts)
    return np.concatenate([[0], np.cumsum(sizes[has_members])]), ids, views[has_members]


def from_moments(moments: Moments, starts: np.ndarray, ids: np.ndarray, views: np.ndarray) -> FeatureGaussians:
    """Make Feature Gaussians of pooled groups, with neutral gains."""
    count = len(moments.means)
    names = ("means", "covars", "weights", "masses", "extinctions", "footprints")
    return FeatureGaussians(
        **{name: to_float32(getattr(moments, name)) for name in names},
        gains=np.ones(count, np.float32),
        sh0=moments.sh[:, :1],
        shN=moments.sh[:, 1:],
        views=views,
        starts=starts,
        members=ids,
        latents=np.zeros((count, 0), np.float32),
    )


def weaken_contradicted(features: FeatureGaussians, members: Members, cameras: Cameras) -> FeatureGaussians:
    """Lower the optical depth of groups if more views see through them than have a surface at their position."""
    f = features
    nearest_views = 64  # number of nearest views that are compared; more views hardly change the result
    _, same_share, behind_share, *_ = cross_view_stats(f.means, f.sh0, f.views, members, cameras, nearest_views).T
    factors = np.where(behind_share > same_share, np.where(same_share > 0, DISPUTED, ALONE), 1)
    return replace(features, gains=features.gains * factors.astype(np.float32))
