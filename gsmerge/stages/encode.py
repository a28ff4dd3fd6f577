"""Groups -> Feature Gaussians: one per superpixel, analytic, corrected by the networks' encoder if any."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gsmerge.kernels.gaussians.pool import group_members
from gsmerge.moments import Members, Moments, Rule, pool_members
from gsmerge.runtime.record import stage
from gsmerge.runtime.threads import parallel_map
from gsmerge.stages.agreement import weaken_contradicted
from gsmerge.types import Cameras, FeatureGaussians, Groups, Scene, to_float32

if TYPE_CHECKING:
    from gsmerge.networks.apply import NetworkContext
    from gsmerge.networks.weights import NetworkWeights


def make_context(
    networks: NetworkWeights | None, members: Members, cameras: Cameras, seed: int
) -> NetworkContext | None:
    """Return networks with the facts of a scene that they read; None without networks."""
    if networks is None:
        return None
    from gsmerge.networks.apply import NetworkContext

    return NetworkContext(networks, members, cameras, seed)


@stage("encode")
def encode(scene: Scene, members: Members, groups: Groups, rule: Rule = "depth") -> FeatureGaussians:
    """Pool every superpixel into one Feature Gaussian, in order of view and label.

    Superpixels without a valid member are left out. ``rule``: see
    :func:`gsmerge.moments.pool_members`.
    """
    starts, ids, views = member_rows(scene, members, groups)
    return from_moments(pool_members(members, starts, ids, rule), starts, ids, views)


@stage("encode")
def correct(
    features: FeatureGaussians, members: Members, cameras: Cameras, networks: NetworkContext | None, *, weaken: bool
) -> FeatureGaussians:
    """Correct pooled Feature Gaussians by the encoder, which adds their latents, too.

    ``weaken``: without networks, lower the optical depth of groups that other views see through; a
    long fit closes the holes that this leaves, and moves what stands before other views less.
    """
    if networks is None:
        return weaken_contradicted(features, members, cameras) if weaken else features
    from gsmerge.networks.apply import encode_features

    return encode_features(features, networks)


def member_rows(scene: Scene, members: Members, groups: Groups) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """List members by superpixel: ``starts [g+1]``, ``ids [m]`` int32, ``views [g]``, without empty superpixels."""
    if scene.aligned:
        sizes, ids = _rows_by_view(scene, groups)
    else:
        assert members.pixels is not None
        counts = np.asarray(groups.counts)
        first = np.cumsum(counts) - counts
        labels = groups.labels.reshape(-1)[members.pixels] + first[members.pixels // scene.pixels_per_view]
        labels = np.where(members.pixels >= 0, labels, -1)
        starts, ids = group_members(labels.astype(np.int32), int(counts.sum()))
        sizes = np.diff(starts)
    filled, views = sizes > 0, np.repeat(np.arange(len(scene)), groups.counts)
    return np.concatenate([[0], np.cumsum(sizes[filled])]), ids.astype(np.int32, copy=False), views[filled]


def _rows_by_view(scene: Scene, groups: Groups) -> tuple[np.ndarray, np.ndarray]:
    """Sort the pixels of each view by superpixel on its own, which needs memory for one view at a time."""

    def one_view(view: int) -> tuple[np.ndarray, np.ndarray]:
        labels = np.where(scene.valid[view], groups.labels[view], -1).reshape(-1).astype(np.int32)
        starts, ids = group_members(labels, groups.counts[view])
        return np.diff(starts), (ids + view * scene.pixels_per_view).astype(np.int32)

    parts = parallel_map(one_view, range(len(scene)))
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


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
