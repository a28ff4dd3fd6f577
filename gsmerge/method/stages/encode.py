"""Groups -> Feature Gaussians: pool each superpixel by closed formulas. Networks may correct the result.

A group becomes fainter if the depths of other views contradict it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.arrays import to_float32
from gsmerge.method.geometry.pooling import FOOTPRINT_ROWS, Members, Rule, pool_members
from gsmerge.method.kernels.gaussians.pool import group_members
from gsmerge.method.networks.corrector import Corrector
from gsmerge.method.networks.cross_view_stats import cross_view_stats
from gsmerge.runtime.record import stage
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, FeatureGaussians, Groups, Scene

# A group is contradicted if more views see through it than have a surface at its position. The optical depth of a
# contradicted group is multiplied by ALONE if no other view has a surface at its position, and otherwise by DISPUTED
ALONE = 0.15
DISPUTED = 0.39


@stage("encode")
def encode(scene: Scene, members: Members, groups: Groups, rule: Rule = "depth") -> FeatureGaussians:
    """Pool every superpixel that has members into one Feature Gaussian, in order of view and label.

    The Feature Gaussians have gains of 1 and no latents.
    :func:`gsmerge.method.geometry.pooling.pool_members` explains the ``rule``.
    """
    starts, ids, views = member_rows(scene, members, groups)
    moments = pool_members(members, starts, ids, rule)
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


@stage("encode")
def correct(
    features: FeatureGaussians, members: Members, cameras: Cameras, networks: Corrector, *, weaken: bool
) -> FeatureGaussians:
    """Correct pooled Feature Gaussians with the encoder of the networks, which also adds latents.

    ``weaken`` makes groups fainter if other views see through them. Fainter groups leave holes, which a long fit
    closes.
    """
    return networks.encode(weaken_contradicted(features, members, cameras) if weaken else features)


def member_rows(scene: Scene, members: Members, groups: Groups) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """List the members of all superpixels that are not empty.

    Returns the start ``[g+1]`` of each superpixel in a list of members, the list itself, which has int32 rows ``[m]``
    of ``members``, and the view ``[g]`` of each superpixel.
    """
    counts = np.asarray(groups.counts)
    offsets, flat = np.cumsum(counts) - counts, groups.labels.reshape(-1)
    labels = np.empty(len(members.pixels), np.int32)

    def label(start: int) -> None:
        """Write the superpixel of each member, numbered through all views, or -1 for a member without a pixel."""
        rows = slice(start, start + FOOTPRINT_ROWS)
        pixels = members.pixels[rows]
        labels[rows] = np.where(pixels >= 0, flat[pixels] + offsets[pixels // scene.pixels_per_view], -1)

    parallel_map(label, range(0, len(labels), FOOTPRINT_ROWS))
    starts, ids = group_members(labels, int(counts.sum()))
    sizes = np.diff(starts)
    has_members = sizes > 0
    views = np.repeat(np.arange(len(scene)), groups.counts)
    return np.concatenate([[0], np.cumsum(sizes[has_members])]), ids, views[has_members]


def weaken_contradicted(features: FeatureGaussians, members: Members, cameras: Cameras) -> FeatureGaussians:
    """Lower the gain, and with it the optical depth, of groups that other views contradict.

    A group is contradicted if more views see through it than have a surface at its position.
    """
    f = features
    nearest_views = 64  # each group is compared with this many nearest views; more hardly change the result
    _, same_share, behind_share, *_ = cross_view_stats(
        f.means, f.sh0, views=f.views, members=members, cameras=cameras, most=nearest_views
    ).T
    factors = np.where(behind_share > same_share, np.where(same_share > 0, DISPUTED, ALONE), 1)
    return replace(features, gains=features.gains * factors.astype(np.float32))
