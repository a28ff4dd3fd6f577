"""The state of views: groups with their children, and what compacting them and adding views need. No behaviour."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from gsmerge.facts.prepare import Frame
from gsmerge.facts.views import resize_cameras
from gsmerge.pooling import Members
from gsmerge.stages.merge import take
from gsmerge.states.division import Division
from gsmerge.types import Cameras, FeatureGaussians, Gaussians

if TYPE_CHECKING:
    from gsmerge.networks.tokens import GroupFeatures
    from gsmerge.networks.weights import NetworkWeights


@dataclass(frozen=True)
class StoredSettings:
    """Settings of the batches on which decoding depends."""

    num_input: int  # Gaussians of all views
    # Gaussians of each group by default, or `"mixed"`, or `"auto"` where the budget was: `target_count` in all
    k: int | str
    max_k: int  # Most children of a group that are stored
    min_opacity: float  # Gaussians below this opacity are left out
    # Gaussians that add less than this to every pixel of every view that they lie in are left out, where no number is
    # to be met; 0: none are
    min_contribution: float
    # The others are of one batch alone
    target_count: int | None = None  # Gaussians that a budget asked for, without those that no view sees
    # Of an unaligned scene, its groups and the empty superpixels whose Gaussians other groups get; None: K Gaussians
    # for each group
    num_slots: int | None = None
    knee_count: int = 0  # Gaussians at the knee of the scene's own curve of distortion: `--budget auto`


@dataclass(frozen=True, eq=False)
class Replay:
    """Stored photos of earlier views, to which decoding fits."""

    images: np.ndarray  # [r,h,w,3] uint8, of the size of the state's cameras
    views: np.ndarray  # [r] int64, rising: which of the state's views they are

    def __len__(self) -> int:
        return len(self.views)


def no_photos(cameras: Cameras) -> Replay:
    """Return an empty store of photos of the cameras' size."""
    return Replay(np.zeros((0, cameras.height, cameras.width, 3), np.uint8), np.zeros(0, np.int64))


@dataclass(frozen=True, eq=False)
class ViewSamples:
    """Gaussians of every view on a coarse grid of pixels, with which groups of other views are compared."""

    means: np.ndarray  # [v,h,w,3] float32, canonical
    opacities: np.ndarray  # [v,h,w] float32, 0 where the pixel has no Gaussian
    sh0: np.ndarray  # [v,h,w,3] float32

    @staticmethod
    def concat(parts: list[ViewSamples]) -> ViewSamples:
        """Concatenate the views of all parts."""
        names = [f.name for f in fields(ViewSamples)]
        return ViewSamples(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def describe(self, learned: Learned, cameras: Cameras) -> GroupFeatures:
        """Compute the networks' inputs for groups; ``cameras`` are those of all views."""
        from gsmerge.networks.cross_view_stats import cross_view_stats
        from gsmerge.networks.tokens import describe_features

        height, width = self.opacities.shape[1:]
        nothing = np.zeros((0, 0), np.float32)  # which statistics do not read
        members = Members(
            means=self.means.reshape(-1, 3),
            quats=nothing,
            scales=nothing,
            opacities=self.opacities.reshape(-1),
            sh0=self.sh0.reshape(-1, 1, 3),
            shN=nothing,
            footprints=nothing,
        )
        grid = resize_cameras(cameras, width, height)
        features, views = learned.refined, learned.views
        stats = cross_view_stats(features.means, features.sh0, views, members, grid)
        return describe_features(features, views, learned.num_members, stats, cameras)


@dataclass(frozen=True, eq=False)
class Learned:
    """Output of the networks for g groups, with the views and numbers of members that later batches need."""

    refined: FeatureGaussians  # The groups after the refiner, without members: what the heads read
    views: np.ndarray  # [g] int64, the view that each group's frame belongs to
    num_members: np.ndarray  # [g] int64, Gaussians that became the group

    def __getitem__(self, rows: np.ndarray) -> Learned:
        """Return the learned data of the groups ``rows``."""
        return Learned(take(self.refined, rows), self.views[rows], self.num_members[rows])

    @staticmethod
    def concat(parts: list[Learned]) -> Learned:
        """Concatenate the groups of all parts."""
        refined = FeatureGaussians.concat([part.refined for part in parts])
        views, num_members = ([getattr(part, name) for part in parts] for name in ("views", "num_members"))
        return Learned(refined, np.concatenate(views), np.concatenate(num_members))


@dataclass(frozen=True, eq=False)
class Heads:
    """Networks whose decoder heads correct the children, and the numbers of each group that the heads read."""

    networks: NetworkWeights  # All of a checkpoint's networks
    views: np.ndarray  # [g] int64, the view that each group's frame belongs to
    group: np.ndarray  # [g,n] the numbers that describe each group


@dataclass(frozen=True, eq=False)
class Colors:
    """Base colours of groups that fit the photos so far."""

    sh0: np.ndarray  # [g,1,3]; that of the Feature Gaussians stays as exported, for the full fit to start from
    # [g] how much earlier photos say about each colour: the diagonal of their normal equations, which is the sum of the
    # squares of the group's blending weights over their half-size pixels
    precision: np.ndarray

    def __getitem__(self, rows: np.ndarray) -> Colors:
        """Return those of some groups."""
        return Colors(self.sh0[rows], self.precision[rows])

    @staticmethod
    def concat(parts: list[Colors]) -> Colors:
        """Concatenate the groups of all parts."""
        sh0, precision = ([getattr(part, name) for part in parts] for name in ("sh0", "precision"))
        return Colors(np.concatenate(sh0), np.concatenate(precision))


@dataclass(frozen=True, eq=False)
class DividedGroups:
    """Groups with their children for every K: of a batch that is alone, just what ``compact`` makes without a fit."""

    features: FeatureGaussians  # g Feature Gaussians, canonical, without members; with latents, as the merger left them
    division: Division  # Their children, before heads
    heads: Heads | None  # Networks that correct the children; None without any
    colors: Colors | None = None  # None without photos, and where heads set the colours
    learned: Learned | None = None  # Where groups keep their latents for later batches
    saliency: np.ndarray | None = None  # As of `GroupSet`

    def __len__(self) -> int:
        return len(self.features)

    @property
    def refined(self) -> FeatureGaussians:
        """The Feature Gaussians that are decoded."""
        return self.features if self.learned is None else self.learned.refined

    @property
    def sh_degree(self) -> int:
        """Degree of the harmonics."""
        return self.division.children.sh_degree


@dataclass(frozen=True, eq=False)
class GroupSet:
    """Groups that batches join, with the Gaussians (children) into which each divides at most."""

    # g Feature Gaussians, canonical. Their members are rows of `children`. Of states with networks, as encoder and
    # merger left them, with latents. Otherwise with gains of one and without latents: what gains and networks did to
    # them is in their moments.
    features: FeatureGaussians
    # The Gaussians of the finest division, group by group; none where heads with absolute outputs make them
    children: Gaussians
    colors: Colors
    learned: Learned | None = None  # Of states with networks
    # [g] float64 mean corner response of the pixels of each group's members, by which K is mixed; None in files of 0.1
    saliency: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.features)

    @property
    def sh_degree(self) -> int:
        """Degree of the harmonics."""
        return self.children.sh_degree


@dataclass(frozen=True, eq=False)
class StateNetworks:
    """Networks of a state whose groups keep their latents, with samples of its views."""

    weights: NetworkWeights  # All networks of a checkpoint
    samples: ViewSamples  # Of all views


@dataclass(frozen=True, eq=False, kw_only=True)
class State:
    """Feature Gaussians of all views so far, to which views are added; it grows with the scene, not with their number.

    The frame is that of the first batch. The cameras are those of all views so far, at the first batch's size.
    ``about`` has plain JSON types: version, options, the report of every batch, and the source of the first if that was
    a file.
    """

    groups: DividedGroups | GroupSet  # Of one batch, divided by its own Gaussians; of several, which later ones join
    kept: Gaussians  # Unseen Gaussians, canonical, merged
    frame: Frame  # From canonical to world
    cameras: Cameras  # The views, canonical
    replay: Replay  # Photos of some of the views
    settings: StoredSettings
    about: Mapping[str, Any]
    networks: StateNetworks | None = None  # None where later batches meet decoded groups

    @property
    def keeps_latents(self) -> bool:
        """Whether groups keep their latents for later batches."""
        return self.networks is not None

    def __len__(self) -> int:
        return len(self.groups)

    def __repr__(self) -> str:
        return f"State({len(self):,} Feature Gaussians of {len(self.cameras):,} views)"

    @property
    def sh_degree(self) -> int:
        """Degree of the harmonics."""
        return self.groups.sh_degree
