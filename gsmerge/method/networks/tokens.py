"""Compute the inputs of the networks, which are numbers without a unit in the frame of each group.

The axes of a frame point right and down in the picture of the group's view, and along the ray from the camera to the
group. Lengths are in units of the Feature Gaussian's size or of the footprint of one pixel. With these frames and
units, inputs do not depend on depth, focal length, resolution or the scale of the world.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gsmerge.arrays import Array, as_array
from gsmerge.frozen import dataclass, replace
from gsmerge.method.geometry.pooling import Members, feature_to_gaussians
from gsmerge.method.kernels.networks.tokens import describe_groups, describe_parts, place_frames
from gsmerge.method.networks.cross_view_stats import NUM_STATS, cross_view_stats
from gsmerge.method.networks.options import GROUP_COLUMNS, MEMBER_COLUMNS, PART_COLUMNS
from gsmerge.types import Cameras, FeatureGaussians, Gaussians


@dataclass(frozen=True, eq=False)
class GroupFeatures:
    """Inputs of the networks for g Feature Gaussians, float32. In training, arrays with a gradient are tensors."""

    features: FeatureGaussians
    base: Gaussians  # Gaussians with the moments of the Feature Gaussians
    frames: Array  # [g,3,3] columns are the axes of each group (right, down, away), in the world
    sizes: Array  # [g] geometric mean of the two largest scales, world units
    footprints: np.ndarray  # [g] size of one pixel, world units
    views: np.ndarray  # [g] int64 view in which the frame is defined
    group: Array  # [g,GROUP_COLUMNS] numbers that describe the group as a whole


def compute_group_features(features: FeatureGaussians, members: Members, cameras: Cameras) -> GroupFeatures:
    """Return the inputs of the networks for Feature Gaussians. ``members`` are the Gaussians of the whole scene."""
    views = choose_token_views(features, members, cameras)
    stats = cross_view_stats(features.means, features.sh0, views, members, cameras)
    return describe_features(features, views, np.diff(features.starts), stats, cameras)


def describe_features(
    features: FeatureGaussians, views: np.ndarray, num_members: np.ndarray, stats: np.ndarray, cameras: Cameras
) -> GroupFeatures:
    """Return the inputs of the networks for Feature Gaussians whose statistics are known.

    ``stats [g,7]`` come from :func:`cross_view_stats`. ``views [g]`` define the frames of the Feature Gaussians, and
    ``num_members [g]`` are their numbers of members.
    """
    bare = make_group_features(features, views, np.zeros((len(features), GROUP_COLUMNS), np.float32), cameras)
    base = bare.base
    group = np.empty((len(features), GROUP_COLUMNS), np.float32)
    columns = (in_order(getattr(features, name)) for name in ("covars", "masses", "extinctions", "weights"))
    describe_groups(
        base.means, base.scales, base.opacities, base.sh0, *columns, num_members, bare.footprints,
        bare.frames, bare.sizes, _contiguous_viewmats(cameras), views, group,
    )  # fmt: skip
    group[:, GROUP_COLUMNS - NUM_STATS :] = np.nan_to_num(stats)
    return replace(bare, group=group)


def make_group_features(
    features: FeatureGaussians, views: np.ndarray, group: np.ndarray, cameras: Cameras
) -> GroupFeatures:
    """Return the inputs of the networks for Feature Gaussians with the numbers ``group [g,GROUP_COLUMNS]``.

    ``views [g]`` define the frames of the Feature Gaussians.
    """
    base = contiguous(feature_to_gaussians(features))
    frames = np.empty((len(features), 3, 3), np.float32)
    sizes = np.empty(len(features), np.float32)
    place_frames(base.means, base.scales, _contiguous_viewmats(cameras), views, frames, sizes)
    return GroupFeatures(
        features, base=base, frames=frames, sizes=sizes, footprints=in_order(features.footprints), views=views,
        group=group,
    )  # fmt: skip


def contiguous(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians with float32 arrays in C order, as the kernels take them."""
    return Gaussians(*(in_order(column) for column in vars(gaussians).values()))


def in_order(values: np.ndarray) -> np.ndarray:
    """Convert an array to float32 in C order."""
    return np.ascontiguousarray(values, np.float32)


def _contiguous_viewmats(cameras: Cameras) -> np.ndarray:
    return np.ascontiguousarray(as_array(cameras.viewmats), np.float64)


def choose_token_views(features: FeatureGaussians, members: Members, cameras: Cameras) -> np.ndarray:
    """Return the view ``[g]`` int64 in which the frame of each Feature Gaussian is defined.

    A Feature Gaussian has the view that it was made from. A Feature Gaussian that was merged across views gets the view
    of most of its members, which are weighted by their opacities.
    """
    views = features.views.copy()
    merged = np.flatnonzero(views < 0)
    if len(merged) == 0:
        return views
    positions, owners = group_rows(features.starts[merged], np.diff(features.starts)[merged])
    ids = features.members[positions]
    pixels = members.pixels[ids]
    member_views = pixels // (cameras.width * cameras.height)
    sums = np.bincount(owners * len(cameras) + member_views, members.opacities[ids], len(merged) * len(cameras))
    views[merged] = sums.reshape(len(merged), -1).argmax(1)
    return views


def part_tokens(
    parts: Gaussians | Members,
    ids: np.ndarray,
    owners: np.ndarray,
    group_features: GroupFeatures,
    columns: int = PART_COLUMNS,
) -> np.ndarray:
    """Return tokens ``[n,columns]`` that describe the Gaussians ``ids [n]`` of ``parts`` relative to their groups.

    ``owners [n]`` are the groups. Members have ``MEMBER_COLUMNS`` columns, all other Gaussians ``PART_COLUMNS``.
    """
    g = group_features
    out = np.zeros((len(ids), columns), np.float32)
    describe_parts(
        parts.means, parts.quats, scales=parts.scales, opacities=parts.opacities, sh0=parts.sh0,
        group_means=g.base.means, group_sh0=g.base.sh0, frames=g.frames, sizes=g.sizes, footprints=g.footprints,
        ids=ids.astype(np.int64, copy=False), owners=owners, members=columns == MEMBER_COLUMNS, out=out,
    )  # fmt: skip
    return out


def split_tables(sizes: np.ndarray, max_width: int) -> Iterator[tuple[np.ndarray, int]]:
    """Split groups of ``sizes [g]`` into tables, and yield the groups and the width of each table.

    A table has groups of similar size. The width of a table is a power of two, at most ``max_width``. Groups with more
    members have to be sampled. How groups are split into tables depends only on their sizes.
    """
    bits = np.frexp(np.maximum(sizes, 1) - 0.5)[1].astype(np.int64)  # exponents of the next powers of two
    widths = np.minimum(1 << bits, max_width)
    max_tokens = 4096  # most tokens of a table; their activations take a megabyte, which fits a processor's cache
    for width in np.unique(widths):
        rows = np.flatnonzero(widths == width)
        step = max(1, max_tokens // int(width))
        for start in range(0, len(rows), step):
            yield rows[start : start + step], int(width)


def group_rows(starts: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions ``[m]`` of the members of all groups, group after group, and the group ``[m]`` of each.

    The members of a group have ``sizes [g]`` adjacent positions from ``starts [g]`` on.
    """
    owners = np.repeat(np.arange(len(sizes)), sizes)
    offsets = np.cumsum(sizes) - sizes
    return np.arange(len(owners)) - offsets[owners] + starts[owners], owners


def sample_members(keys: np.ndarray, sizes: np.ndarray, width: int, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sample at most ``width`` members of each group, evenly along the keys of the members.

    ``keys [m]`` has the keys of one group after another, and ``sizes [g]`` are the numbers of members. A group with
    more than ``width`` members is sorted by its keys and cut into ``width`` runs of similar length. ``seeds [g]``
    uint64 choose a random member of each run, so that the sample covers the group (paper supplement, encoder compute).

    Returns positions ``[g,width]`` in ``keys``, and a mask ``[g,width]`` that is false where a group has too few
    members. Where the mask is false, the position belongs to the group's first member.
    """
    offsets = np.cumsum(sizes) - sizes
    order = np.lexsort((keys, np.repeat(np.arange(len(sizes)), sizes)))
    slots = np.arange(width)[None]
    large = (sizes > width)[:, None]
    run_starts = slots * sizes[:, None] // width
    run_sizes = (slots + 1) * sizes[:, None] // width - run_starts
    draws = run_starts + np.floor(hash_uniform(seeds[:, None], slots.astype(np.uint64)) * run_sizes).astype(np.int64)
    within = np.where(large, draws, np.minimum(slots, sizes[:, None] - 1))
    mask = large | (slots < sizes[:, None])
    return order[offsets[:, None] + np.where(mask, within, 0)], mask


def hash_uniform(seeds: np.ndarray, salts: np.ndarray) -> np.ndarray:
    """Return evenly distributed numbers in [0, 1), one for each pair of a seed and a salt, both uint64."""
    return (hash_pairs(seeds, salts) >> np.uint64(11)).astype(np.float64) * 2.0**-53


def hash_pairs(seeds: np.ndarray, salts: np.ndarray) -> np.ndarray:
    """Hash pairs of a seed and a salt, both uint64, to uint64 (splitmix64, Steele 2014)."""
    x = seeds + (salts + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


def point_seeds(points: np.ndarray, seed: int) -> np.ndarray:
    """Return a seed ``[n]`` uint64 for each of ``points [n,3]``, which depends only on its position and ``seed``."""
    bits = np.ascontiguousarray(points, np.float32).view(np.uint32).astype(np.uint64)
    hashes = np.full(len(points), seed & (2**64 - 1), np.uint64)
    for column in bits.T:
        hashes = hash_pairs(hashes, column)
    return hashes
