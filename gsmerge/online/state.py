"""What is kept between two batches of views, and what is decoded from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsmerge import __version__
from gsmerge.encoded.decode import children_of
from gsmerge.encoded.divide import divide_all
from gsmerge.encoded.encoded import Encoded, StoredSettings, without_members
from gsmerge.geometry import covariances
from gsmerge.moments import MAX_OPACITY, Members, Rule, feature_to_gaussians, gaussian_members
from gsmerge.networks import NetworkContext, decode_gaussians
from gsmerge.stages.decode import divide
from gsmerge.stages.merge import take
from gsmerge.stages.prepare import Frame
from gsmerge.types import Cameras, FeatureGaussians, Gaussians

POOLED: Rule = "depth"  # children stand for many members: their own size counts, whatever rule they were made by
NO_FLOOR = 1e-3  # of the footprints of members that are children


@dataclass(frozen=True, eq=False)
class Replay:
    """Photos of earlier views.

    Args:
        images: ``[r,h,w,3]`` uint8, of the size of the state's cameras.
        views: ``[r]`` int64, rising: which of the state's views they are.
    """

    images: np.ndarray
    views: np.ndarray

    def __len__(self) -> int:
        return len(self.views)


def no_photos(cameras: Cameras) -> Replay:
    """None at all, of the size of some views."""
    return Replay(np.zeros((0, cameras.height, cameras.width, 3), np.uint8), np.zeros(0, np.int64))


@dataclass(frozen=True, eq=False)
class Parts:
    """Groups with the Gaussians that they divide into.

    Args:
        features: g Feature Gaussians, canonical, with gains and spreads of one and without latents: what gains,
            spreads and networks did to them is in their moments. Their members are rows of ``children``.
        children: The Gaussians of the finest division, group by group.
        solved: ``[g,1,3]`` base colours (sh0) that fit the photos so far; those of the features are as they came, for a
            fit to begin with that has not seen the photos yet.
        held: ``[g]`` what earlier photos say of each solved colour: diagonal of their normal equations, the sum of the
            squares of the group's blending weights over their pixels (of half-size photos).
    """

    features: FeatureGaussians
    children: Gaussians
    solved: Tensor
    held: Tensor

    def __len__(self) -> int:
        return len(self.features)


@dataclass(frozen=True, eq=False)
class OnlineState:
    """Everything that new views are added to. Its size follows the scene, not the number of views.

    Args:
        parts: The groups.
        kept: Gaussians that no view sees, canonical; None without any.
        frame: From canonical to world, that of the first batch.
        cameras: All views so far, canonical, at the size of the first batch.
        replay: Photos of some of them.
        settings: As of an encoded scene.
        about: Options, batches, version; plain JSON types.
    """

    parts: Parts
    kept: Gaussians | None
    frame: Frame
    cameras: Cameras
    replay: Replay
    settings: StoredSettings
    about: Mapping[str, Any]

    def __len__(self) -> int:
        return len(self.parts)

    @property
    def sh_degree(self) -> int:
        """Degree of the harmonics."""
        return self.parts.children.sh_degree


def baked(
    features: FeatureGaussians, members: Members, networks: NetworkContext | None, most: int, rule: Rule = "depth"
) -> Parts:
    """Groups as what they decode to: gains, spreads, latents and heads are in the result and needed no more.

    Args:
        features: g Feature Gaussians with their members.
        members: The Gaussians that they point to.
        networks: Networks whose heads correct what is decoded; None: none do.
        most: Most children that are kept of a group.
        rule: How children are pooled.
    """
    ones = feature_to_gaussians(features)
    children, parents = ones, np.arange(len(features))
    if most > 1:
        children, parents = divide(features, members, np.full(len(features), most), rule)
    if networks is not None:
        ones = decode_gaussians(ones, np.arange(len(features)), features, networks)
        children = decode_gaussians(children, parents, features, networks)
    return _parts(features, ones, children, parents)


def _parts(features: FeatureGaussians, ones: Gaussians, children: Gaussians, parents: np.ndarray) -> Parts:
    """Groups with the moments of what they decode to, and the children, of whom ``parents`` rising are the groups."""
    neutral, no_latents = torch.ones(len(features)), torch.zeros(len(features), 0)
    same = replace(features, gains=neutral, spreads=neutral, latents=no_latents, **moments_of(ones))
    return Parts(owning(same, parents), children, ones.sh0, torch.zeros(len(features)))


def from_encoded(encoded: Encoded) -> OnlineState:
    """The state that an encoded scene is: of one batch, without photos."""
    most = encoded.settings.most
    ones, _ = children_of(encoded, np.ones(len(encoded), np.int64))
    children, parents = children_of(encoded, np.full(len(encoded), most))
    parts = _parts(encoded.features, ones, children, parents)
    cameras = encoded.cameras
    settings = replace(encoded.settings, wanted=None, places=None)
    options = dict(encoded.about.get("options", {}))
    options.pop("fit", None)  # none, for want of photos
    batch = {"num_views": len(cameras), "num_input": settings.num_input, "num_new": len(encoded)}
    batch |= {"num_covered": 0, "num_joined": 0, "num_hidden": 0, "num_groups": len(encoded)}
    about = {"gsmerge": __version__, "options": options, "batches": [batch]}
    return OnlineState(parts, encoded.kept, encoded.frame, cameras, no_photos(cameras), settings, about)


def moments_of(gaussians: Gaussians) -> dict[str, Tensor]:
    """The fields of Feature Gaussians that decode to given Gaussians, at gains and spreads of one."""
    scales = gaussians.scales.double().sort(-1).values
    opacities = gaussians.opacities.double().clamp(0, MAX_OPACITY)
    return {
        "means": gaussians.means,
        "covars": covariances(gaussians.quats.double(), gaussians.scales.double()).float(),
        "extinctions": (-torch.log1p(-opacities) * scales[:, 1] * scales[:, 2]).float(),
        "sh0": gaussians.sh0,
        "shN": gaussians.shN,
    }


def owning(features: FeatureGaussians, parents: np.ndarray) -> FeatureGaussians:
    """Feature Gaussians whose members are the rows 0, 1, ... of their children; ``parents`` rising."""
    sizes = torch.bincount(torch.from_numpy(parents), minlength=len(features))
    starts = torch.cat([torch.zeros(1, dtype=torch.int64), sizes.cumsum(0)])
    return replace(features, starts=starts, members=torch.arange(int(starts[-1])))


def part_members(parts: Parts) -> Members:
    """The children as members of their groups, their least size already in them."""
    sizes = parts.features.starts.diff()
    footprints = NO_FLOOR * parts.features.footprints.repeat_interleave(sizes)
    return gaussian_members(parts.children, footprints.numpy())


def pick(parts: Parts, rows: Tensor) -> Parts:
    """Some of the groups, with their children."""
    features = take(parts.features, rows)
    children = parts.children[features.members]
    members = torch.arange(len(children))
    return Parts(replace(features, members=members), children, parts.solved[rows], parts.held[rows])


def joined(parts: list[Parts]) -> Parts:
    """All groups of all parts in order."""
    features = FeatureGaussians.concat([p.features for p in parts])
    children = Gaussians.concat([p.children for p in parts])
    features = replace(features, members=torch.arange(len(children)))
    solved, held = torch.cat([p.solved for p in parts]), torch.cat([p.held for p in parts])
    return Parts(features, children, solved, held)


def thinned(parts: Parts, most: int) -> Parts:
    """Groups with at most ``most`` children each, those of larger ones pooled."""
    crowded = torch.nonzero(parts.features.starts.diff() > most)[:, 0]
    if len(crowded) == 0:
        return parts
    few = pick(parts, crowded)
    children, parents = divide(few.features, part_members(few), np.full(len(few), most), POOLED)
    return swapped(parts, crowded, replace(few, features=owning(few.features, parents), children=children))


def swapped(parts: Parts, rows: Tensor, others: Parts) -> Parts:
    """The groups with some replaced by others, one for one and in place."""
    index = torch.arange(len(parts))
    index[rows] = len(parts) + torch.arange(len(rows))
    return pick(joined([parts, others]), index)


def with_solved(parts: Parts) -> Parts:
    """Groups and children in the colours that fit the photos."""
    offsets = parts.solved - parts.features.sh0
    sizes = parts.features.starts.diff()
    features = replace(parts.features, sh0=parts.solved)
    children = replace(parts.children, sh0=parts.children.sh0 + offsets.repeat_interleave(sizes, 0))
    return replace(parts, features=features, children=children)


def as_encoded(state: OnlineState, *, solved: bool = True) -> Encoded:
    """The state as an encoded scene, which decodes at any K and budget.

    Args:
        state: Of one or more batches.
        solved: Colours that fit the photos; otherwise as they came.
    """
    parts = with_solved(state.parts) if solved else state.parts
    features, members = parts.features, part_members(parts)
    return Encoded(
        features=without_members(features),
        division=divide_all(features, members, state.settings.most, POOLED),
        kept=state.kept,
        frame=state.frame,
        cameras=state.cameras,
        settings=replace(state.settings, knee=len(features)),
        heads=None,
        about=state.about,
    )
