"""What is kept of a scene: frozen dataclasses, nothing but sizes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gsmerge.networks import Networks
from gsmerge.stages.prepare import Frame
from gsmerge.types import Cameras, FeatureGaussians, Gaussians


@dataclass(frozen=True, eq=False)
class Division:
    """The children of every Feature Gaussian, for every K up to a limit, as the splits that lead to them.

    The members of a group are halved again and again (:mod:`gsmerge.stages.decode`), so the children of K are those of
    K - 1 with one of them replaced by its halves. A third of the members' bytes, and nothing to pool when decoding.

    Args:
        splits: ``[g]`` uint8, times that each group is split.
        slots: ``[s]`` uint8, which child, counted in order from 0, each split replaces; group by group.
        whole: ``[w]`` int64, rising: the groups whose members are all alike. Asked for more, they give one child.
        children: 2s + w Gaussians, canonical: two for each split, then one for each of ``whole``.
        deals: ``[d]`` int64, the group that each further Gaussian goes to, where it helps most first.
    """

    splits: Tensor
    slots: Tensor
    whole: Tensor
    children: Gaussians
    deals: Tensor


@dataclass(frozen=True, eq=False)
class StoredHeads:
    """Networks whose decoder heads correct the children, and what they know of the groups.

    Args:
        networks: All of a checkpoint's networks.
        views: ``[g]`` int64, the view that each group's frame belongs to.
        group: ``[g,n]`` the numbers that describe each group.
    """

    networks: Networks
    views: Tensor
    group: Tensor


@dataclass(frozen=True)
class StoredSettings:
    """What decoding needs to know of the encoding.

    Args:
        num_input: Gaussians of the scene.
        k: Gaussians of each group unless told otherwise, or ``"auto"``: ``wanted`` of them, found for the scene.
        most: Most children of a group that are kept.
        min_opacity: Gaussians below this opacity are left out.
        prune: Gaussians that add less than this to every pixel of every view that they lie in are left out, where no
            number is to be met; 0: none are.
        wanted: Gaussians that a budget asked for, without those that no view sees; None without one.
        places: Groups, and empty superpixels whose Gaussians the others get, of a scene in no order; None: K each.
        knee: Gaussians at the knee of the scene's own curve of distortion: ``--k auto`` without photos.
    """

    num_input: int
    k: int | str
    most: int
    min_opacity: float
    prune: float
    wanted: int | None
    places: int | None
    knee: int


@dataclass(frozen=True, eq=False)
class Encoded:
    """A scene as merged Feature Gaussians, ready to be decoded at any K without its images.

    Args:
        features: g Feature Gaussians, canonical, without their members.
        division: Their children.
        kept: Gaussians that no view sees, merged already, canonical; None without any.
        frame: From canonical to world.
        cameras: The views, canonical; what shows in none of them is left out.
        settings: What decoding needs to know.
        heads: Networks that correct the children; None without any.
        about: Where it comes from: version, options, choices, notes, and the source if it was a file. Plain JSON types.
    """

    features: FeatureGaussians
    division: Division
    kept: Gaussians | None
    frame: Frame
    cameras: Cameras
    settings: StoredSettings
    heads: StoredHeads | None
    about: Mapping[str, Any]

    def __len__(self) -> int:
        return len(self.features)

    @property
    def sh_degree(self) -> int:
        """Degree of the harmonics."""
        return self.division.children.sh_degree

    @property
    def num_kept(self) -> int:
        """Gaussians that no view sees."""
        return 0 if self.kept is None else len(self.kept)

    @property
    def num_most(self) -> int:
        """Most Gaussians that it decodes to."""
        return len(self) + len(self.division.slots) + self.num_kept


def without_members(features: FeatureGaussians) -> FeatureGaussians:
    """Feature Gaussians that know of no members."""
    starts = torch.zeros(len(features) + 1, dtype=torch.int64)
    return replace(features, starts=starts, members=torch.zeros(0, dtype=torch.int64))
