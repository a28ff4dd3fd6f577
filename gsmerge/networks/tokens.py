"""Inputs of the networks: numbers without a unit, in a frame of each group.

The frame is aligned to the ray that the group was seen along, with the image's right and down of its own view. Lengths
are in units of the Feature Gaussian's size or of one pixel's footprint there, so that nothing depends on depth, focal
length, resolution or the scale of the world.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gsmerge.moments import Members, feature_to_gaussians
from gsmerge.networks.cross_view_stats import NUM_STATS, cross_view_stats
from gsmerge.networks.residuals import gaussian_sizes, quat_to_rotmat
from gsmerge.types import SH_C0, Array, Cameras, FeatureGaussians, Gaussians, as_tensor

PART = 13  # columns of a Gaussian relative to another one: position, log scales, opacity, colour, normal
MEMBER = PART + 6  # and its position in footprints and its colour
GROUP = 19 + NUM_STATS  # columns of a whole group
TINY = 1e-12  # world units; lengths are clamped to it before a division or logarithm
TOKENS = 4096  # tokens of one table: a megabyte of activations, which stay in a processor's cache


@dataclass(frozen=True, eq=False)
class GroupFeatures:
    """Feature Gaussians as tensors that the networks read."""

    features: FeatureGaussians  # g of them
    base: Gaussians  # g Gaussians without corrections
    frames: Tensor  # [g,3,3] axes (right, down, away) as columns, world
    sizes: Tensor  # [g] geometric mean of the two largest scales, world units
    footprints: Tensor  # [g] size of one pixel, world units
    views: Tensor  # [g] int64 view that the frame belongs to
    group: Tensor  # [g,GROUP] numbers that describe the whole group


def compute_group_features(features: FeatureGaussians, members: Members, cameras: Cameras) -> GroupFeatures:
    """Compute the networks' inputs for Feature Gaussians."""
    views = _choose_views(features, members, cameras)
    bare = make_group_features(features, views, np.zeros((len(features), 0), np.float32), cameras)
    viewmats = cameras.to("cpu").viewmats.float()[bare.views]
    places = (viewmats[:, :3, :3] @ bare.base.means[:, :, None])[:, :, 0] + viewmats[:, :3, 3]
    tangents = (places[:, :2] / places[:, 2:].clamp_min(1e-6)).clamp(-3, 3)  # of the angles to the view's axis
    stats = as_tensor(cross_view_stats(features.means, features.sh0, views, members, cameras))
    return replace(bare, group=torch.cat([_group_numbers(bare), tangents, stats], 1).nan_to_num())


def make_group_features(features: FeatureGaussians, views: Array, group: Array, cameras: Cameras) -> GroupFeatures:
    """Make the networks' inputs from known ``views [g]`` and numbers ``group [g,GROUP]``, without the members."""
    base, views = feature_to_gaussians(features).to("cpu"), as_tensor(views)
    sizes = gaussian_sizes(base.scales).clamp_min(TINY)
    footprints = as_tensor(features.footprints).clamp_min(TINY)
    frames = _ray_frames(base.means, views, cameras.to("cpu"))
    return GroupFeatures(features, base, frames, sizes, footprints, views, as_tensor(group))


def _group_numbers(bare: GroupFeatures) -> Tensor:
    """Describe groups by ``[g,17]`` scales, opacity, mass, optical depth, members, colour and covariance."""
    features, base, frames, sizes, footprints = bare.features, bare.base, bare.frames, bare.sizes, bare.footprints
    names = ("covars", "masses", "extinctions", "weights")
    covars, masses, extinctions, weights = (as_tensor(getattr(features, name)) for name in names)
    num_members = as_tensor(np.diff(features.starts)).float()
    local = frames.transpose(1, 2) @ (covars / sizes[:, None, None] ** 2) @ frames
    columns = [
        torch.log(base.scales.clamp_min(TINY) / footprints[:, None]).clamp(-12, 12) / 4,
        _logits(base.opacities)[:, None],
        torch.log(masses.clamp_min(1e-30) / footprints**3)[:, None].clamp(-30, 30) / 10,
        torch.log(extinctions.clamp_min(1e-30) / footprints**2)[:, None].clamp(-30, 30) / 10,
        torch.log(num_members)[:, None] / 4,
        (weights / num_members)[:, None],
        SH_C0 * base.sh0[:, 0],
        torch.asinh(local.flatten(1)[:, [0, 1, 2, 4, 5, 8]]),
    ]
    return torch.cat(columns, 1)


def _logits(opacities: Tensor) -> Tensor:
    """Compute logits of opacities, clamped to finite bounds, divided by 3."""
    return torch.logit(opacities.clamp(1e-4, 1 - 1e-4)) / 3


def _choose_views(features: FeatureGaussians, members: Members, cameras: Cameras) -> np.ndarray:
    """Choose the view of each Feature Gaussian, ``[g]`` int64: its own, or if merged the one with most opacity."""
    views = features.views.copy()
    merged = np.flatnonzero(views < 0)
    if len(merged) == 0:
        return views
    positions, owners = group_rows(features.starts[merged], np.diff(features.starts)[merged])
    ids = features.members[positions]
    pixels = ids if members.pixels is None else members.pixels[ids]
    seen = pixels // (cameras.width * cameras.height)
    sums = np.bincount(owners * len(cameras) + seen, members.opacities[ids], len(merged) * len(cameras))
    views[merged] = sums.reshape(len(merged), -1).argmax(1)
    return views


def _ray_frames(means: Tensor, views: Tensor, cameras: Cameras) -> Tensor:
    """Compute frames ``[n,3,3]`` of points in ``views [n]``: image right, image down and the ray as columns."""
    rotations, centres = cameras.viewmats[:, :3, :3].float()[views], cameras.centres.float()[views]
    normalize = torch.nn.functional.normalize
    away = means - centres
    away = normalize(torch.where(away.norm(dim=1, keepdim=True) > TINY, away, rotations[:, 2]), dim=1)
    right, ahead = (axis - (axis * away).sum(1, keepdim=True) * away for axis in (rotations[:, 0], rotations[:, 2]))
    right = normalize(torch.where(right.norm(dim=1, keepdim=True) > 1e-3, right, ahead), dim=1)
    return torch.stack([right, torch.linalg.cross(away, right), away], 2)


def part_tokens(parts: Gaussians, group_features: GroupFeatures, owners: Tensor) -> Tensor:
    """Describe n Gaussians relative to the Feature Gaussians ``owners [n]`` that they belong to, ``[n,PART]``."""
    g = group_features
    frames = g.frames[owners].transpose(1, 2)
    normals = quat_to_rotmat(parts.quats)[torch.arange(len(parts)), :, parts.scales.argmin(1)]
    axes = frames @ torch.stack([parts.means - g.base.means[owners], normals], 2)
    scales = parts.scales.sort(1).values.clamp_min(TINY)
    flat = 1 - scales[:, :1] / scales[:, 1:2]  # a round Gaussian has no normal, so that rounding cannot choose one
    normals = -flat * axes[:, :, 1] * torch.sign(axes[:, 2:, 1])  # towards the camera
    columns = [
        torch.asinh(axes[:, :, 0] / g.sizes[owners, None]),
        torch.log(scales / g.footprints[owners, None]).clamp(-12, 12) / 4,
        _logits(parts.opacities)[:, None],
        SH_C0 * (parts.sh0[:, 0] - g.base.sh0[owners, 0]),
        normals,
    ]
    return torch.cat(columns, 1).nan_to_num()


def member_tokens(members: Members, ids: np.ndarray, group_features: GroupFeatures, owners: Tensor) -> Tensor:
    """Describe members ``ids [n]`` relative to their Feature Gaussians ``owners [n]``, ``[n,MEMBER]``."""
    columns = (members.means, members.quats, members.scales, members.opacities, members.sh0, members.shN[:, :0])
    picked = Gaussians(*(torch.from_numpy(column[ids]) for column in columns))
    tokens = part_tokens(picked, group_features, owners)
    places = group_features.sizes[owners, None] / group_features.footprints[owners, None] * torch.sinh(tokens[:, :3])
    return torch.cat([tokens, torch.asinh(places), SH_C0 * picked.sh0[:, 0]], 1)


def split_tables(sizes: np.ndarray, max_width: int) -> Iterator[tuple[np.ndarray, int]]:
    """Split groups of ``sizes [g]`` into tables of similar size: rows of ``sizes``, and a width, a power of two.

    Which groups share a table depends only on the sizes. Groups larger than ``max_width`` are sampled.
    """
    widths = np.minimum(1 << np.ceil(np.log2(np.maximum(sizes, 1))).astype(np.int64), max_width)
    for width in np.unique(widths):
        rows = np.flatnonzero(widths == width)
        step = max(1, TOKENS // int(width))
        for first in range(0, len(rows), step):
            yield rows[first : first + step], int(width)


def group_rows(begins: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the positions of all members of groups that begin at ``begins [g]``, and the group of each."""
    owners = np.repeat(np.arange(len(sizes)), sizes)
    first = np.cumsum(sizes) - sizes
    return np.arange(len(owners)) - first[owners] + begins[owners], owners


def sample_members(keys: np.ndarray, sizes: np.ndarray, width: int, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Choose at most ``width`` members of every group, sorted by their ``keys [m]``, whatever their order.

    Keys come group by group, ``sizes [g]`` of each. A group that is too large is cut along its key into ``width`` runs
    as equal as possible, and one member of each is taken at random from ``seeds [g]`` uint64: the sample covers the
    group (paper supplement, encoder compute). Returned are ``[g,width]`` positions into ``keys``, and a mask of the
    valid ones; the others repeat the group's first.
    """
    first = np.cumsum(sizes) - sizes
    order = np.lexsort((keys, np.repeat(np.arange(len(sizes)), sizes)))
    slots = np.arange(width)[None]
    large = (sizes > width)[:, None]
    low = slots * sizes[:, None] // width
    high = (slots + 1) * sizes[:, None] // width
    draws = low + np.floor(hash_uniform(seeds[:, None], slots.astype(np.uint64)) * (high - low)).astype(np.int64)
    within = np.where(large, draws, np.minimum(slots, sizes[:, None] - 1))
    mask = large | (slots < sizes[:, None])
    return order[first[:, None] + np.where(mask, within, 0)], mask


def hash_uniform(seeds: np.ndarray, salts: np.ndarray) -> np.ndarray:
    """Draw numbers in [0, 1) that depend only on seeds and salts (splitmix64, Steele et al. 2014)."""
    return (hash_pairs(seeds, salts) >> np.uint64(11)).astype(np.float64) * 2.0**-53


def hash_pairs(seeds: np.ndarray, salts: np.ndarray) -> np.ndarray:
    """Hash pairs of uint64 to uint64."""
    x = seeds + (salts + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


def point_seeds(points: np.ndarray, seed: int) -> np.ndarray:
    """Hash float32 positions ``[n,3]`` with a seed to ``[n]`` uint64, whatever the order of the points."""
    bits = np.ascontiguousarray(points, np.float32).view(np.uint32).astype(np.uint64)
    hashes = np.full(len(points), seed & (2**64 - 1), np.uint64)
    for column in bits.T:
        hashes = hash_pairs(hashes, column)
    return hashes
