"""Content of a ``.gsm`` file: frozen dataclasses, no behaviour beyond sizes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from gsmerge.facts.prepare import Frame
from gsmerge.types import Cameras, FeatureGaussians, Gaussians

if TYPE_CHECKING:
    from gsmerge.networks.weights import NetworkWeights


@dataclass(frozen=True, eq=False)
class Division:
    """The children of every Feature Gaussian for all K up to a limit, stored as a sequence of splits.

    Each split halves one child (:mod:`gsmerge.stages.decode`), so the children for K are those for K - 1 with one
    replaced by its two halves. This takes a third of the members' bytes, and decoding has nothing to pool.
    """

    # [g] uint8, times that each group is split. Where heads make the children of nothing, that is all there is, and
    # the three arrays after it are empty.
    splits: np.ndarray
    slots: np.ndarray  # [s] uint8, which child, counted in order from 0, each split replaces; group by group
    # [w] int64, rising: the groups whose members are all alike. Asked for more, they give one child.
    uniform: np.ndarray
    children: Gaussians  # 2s + w Gaussians, canonical: two for each split, then one for each of `uniform`
    growth_order: np.ndarray  # [d] int64, the group that each further Gaussian goes to, where it helps most first

    @property
    def by_heads(self) -> bool:
        """Whether decoder heads make the children alone, without stored ones."""
        return len(self.slots) < self.num_splits

    @property
    def num_splits(self) -> int:
        """Number of splits in all groups; each adds one Gaussian."""
        return int(self.splits.sum(dtype=np.int64))


@dataclass(frozen=True, eq=False)
class StoredHeads:
    """Networks whose decoder heads correct the children, and the numbers of each group that the heads read."""

    networks: NetworkWeights  # All of a checkpoint's networks
    views: np.ndarray  # [g] int64, the view that each group's frame belongs to
    group: np.ndarray  # [g,n] the numbers that describe each group


@dataclass(frozen=True)
class StoredSettings:
    """Settings of the encoding on which decoding depends."""

    num_input: int  # Gaussians of the scene
    k: int | str  # Gaussians of each group by default, or `"auto"` where the budget was: `target_count` in all
    max_k: int  # Most children of a group that are stored
    min_opacity: float  # Gaussians below this opacity are left out
    # Gaussians that add less than this to every pixel of every view that they lie in are left out, where no number is
    # to be met; 0: none are
    min_contribution: float
    target_count: int | None = None  # Gaussians that a budget asked for, without those that no view sees
    # Of an unaligned scene, its groups and the empty superpixels whose Gaussians other groups get; None: K Gaussians
    # for each group
    num_slots: int | None = None
    knee_count: int = 0  # Gaussians at the knee of the scene's own curve of distortion: `--budget auto`


@dataclass(frozen=True, eq=False, kw_only=True)
class StoredScene:
    """Base of encoded scenes and of online states: frame, cameras, settings and kept Gaussians."""

    kept: Gaussians | None  # Unseen Gaussians, canonical, merged; None without any
    frame: Frame  # From canonical to world
    cameras: Cameras  # The views, canonical
    settings: StoredSettings  # What decoding needs to know
    about: Mapping[str, Any]  # Origin as plain JSON types: version, options, more by kind


@dataclass(frozen=True, eq=False, kw_only=True)
class Encoded(StoredScene):
    """A scene as merged Feature Gaussians, ready to be decoded at any K without its images.

    What shows in none of its views is left out. ``about`` also has choices, notes, and the source if it was a file.

    Args:
        features: g Feature Gaussians, canonical, without their members.
        division: Their children.
        heads: Networks that correct the children; None without any.

    Example:
        >>> encoded = gsmerge.encode_scene(gsmerge.read_scene("demo"), superpixels="2%")
        >>> len(encoded) == len(encoded.features)
        True
    """

    features: FeatureGaussians
    division: Division
    heads: StoredHeads | None

    def __len__(self) -> int:
        return len(self.features)

    def __repr__(self) -> str:
        return f"Encoded({len(self):,} Feature Gaussians, up to {self.max_gaussians:,} Gaussians)"

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics."""
        return self.division.children.sh_degree

    @property
    def num_kept(self) -> int:
        """Number of kept Gaussians that no view sees."""
        return 0 if self.kept is None else len(self.kept)

    @property
    def max_gaussians(self) -> int:
        """Largest number of Gaussians that the scene decodes to."""
        return len(self) + self.division.num_splits + self.num_kept


def without_members(features: FeatureGaussians) -> FeatureGaussians:
    """Return the Feature Gaussians without their members."""
    return replace(features, starts=np.zeros(len(features) + 1, np.int64), members=np.zeros(0, np.int64))
