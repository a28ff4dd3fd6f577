"""State between two batches of views, and operations on its groups."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from gsmerge import __version__
from gsmerge.facts.views import resize_cameras
from gsmerge.geometry import covariances
from gsmerge.kernels.elementary import log1p
from gsmerge.moments import MAX_OPACITY, Members, feature_to_gaussians, gaussian_members
from gsmerge.stages.decode import divide
from gsmerge.stages.merge import take
from gsmerge.states.encoded import Encoded, StoredHeads, StoredScene, without_members
from gsmerge.states.to_gaussians import children_of, divide_all, divide_by_heads
from gsmerge.types import Cameras, FeatureGaussians, Gaussians, to_float32

if TYPE_CHECKING:
    from gsmerge.networks.apply import NetworkContext
    from gsmerge.networks.tokens import GroupFeatures
    from gsmerge.networks.weights import NetworkWeights

CHILD_FOOTPRINT = 1e-3  # of the group's: children need no least size, as it is in their own


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


def sample_views(members: Members, cameras: Cameras, shape: tuple[int, int]) -> ViewSamples:
    """Sample the Gaussians that the pixels at the centres of a grid of ``shape`` show."""
    (height, width), num_views = shape, len(cameras)
    rows = ((2 * np.arange(height) + 1) * cameras.height) // (2 * height)
    columns = ((2 * np.arange(width) + 1) * cameras.width) // (2 * width)
    pixels = (rows[:, None] * cameras.width + columns).reshape(-1)
    ids = (np.arange(num_views)[:, None] * (cameras.width * cameras.height) + pixels).reshape(-1)
    if members.pixels is not None:
        ids = np.full_like(ids, -1) if members.fronts is None else members.fronts.reshape(-1)[ids]
    means, sh0 = members.means[ids], members.sh0[ids, 0]
    usable = (ids >= 0) & np.isfinite(means).all(1) & np.isfinite(sh0).all(1) & np.isfinite(members.opacities[ids])
    grid = num_views, height, width
    return ViewSamples(
        np.where(usable[:, None], means, 0).astype(np.float32).reshape(*grid, 3),
        np.where(usable, members.opacities[ids], 0).astype(np.float32).reshape(grid),
        np.where(usable[:, None], sh0, 0).astype(np.float32).reshape(*grid, 3),
    )


@dataclass(frozen=True, eq=False)
class Learned:
    """Output of the networks for g groups, with the views and numbers of members that later batches need."""

    refined: FeatureGaussians  # The groups after the refiner, without members: what the heads read
    views: np.ndarray  # [g] int64, the view that each group's frame belongs to
    num_members: np.ndarray  # [g] int64, Gaussians that became the group

    def __getitem__(self, rows: np.ndarray) -> Learned:
        """Return that of some groups."""
        return Learned(take(self.refined, rows), self.views[rows], self.num_members[rows])

    @staticmethod
    def concat(parts: list[Learned]) -> Learned:
        """Concatenate the groups of all parts."""
        refined = FeatureGaussians.concat([part.refined for part in parts])
        views, num_members = ([getattr(part, name) for part in parts] for name in ("views", "num_members"))
        return Learned(refined, np.concatenate(views), np.concatenate(num_members))


@dataclass(frozen=True, eq=False)
class GroupSet:
    """Groups of a state, with the Gaussians (children) into which each divides."""

    # g Feature Gaussians, canonical. Their members are rows of `children`. Of states with networks, as encoder and
    # merger left them, with latents. Otherwise with gains of one and without latents: what gains and networks did to
    # them is in their moments.
    features: FeatureGaussians
    # The Gaussians of the finest division, group by group; none where heads with absolute outputs make them
    children: Gaussians
    # [g,1,3] base colours (sh0) that fit the photos so far. `features.sh0` stays as exported, for the full fit to
    # start from.
    fitted_sh0: np.ndarray
    # [g] how much earlier photos say about each fitted colour: the diagonal of their normal equations, which is the
    # sum of the squares of the group's blending weights over their half-size pixels
    color_precision: np.ndarray
    learned: Learned | None = None  # Of states with networks

    def __len__(self) -> int:
        return len(self.features)


@dataclass(frozen=True, eq=False)
class StateNetworks:
    """Networks of a state, with samples of its views; the groups are as these networks left them."""

    weights: NetworkWeights  # All networks of a checkpoint
    samples: ViewSamples  # Of all views


@dataclass(frozen=True, eq=False, kw_only=True)
class OnlineState(StoredScene):
    """State to which new views are added; its size grows with the scene, not with the number of views.

    The frame is that of the first batch. The cameras are those of all views so far, at the first batch's size.
    ``about`` also holds the report of every batch.
    """

    groups: GroupSet
    replay: Replay  # Photos of some of the views
    networks: StateNetworks | None = None  # None where the groups are decoded already

    def __len__(self) -> int:
        return len(self.groups)

    @property
    def sh_degree(self) -> int:
        """Degree of the harmonics."""
        return self.groups.children.sh_degree


def bake(features: FeatureGaussians, members: Members, networks: NetworkContext | None, max_k: int) -> GroupSet:
    """Decode groups into moments and children, so that gains, latents and decoder heads are no longer needed."""
    ones = feature_to_gaussians(features)
    children, parents = ones, np.arange(len(features))
    if max_k > 1:
        children, parents = divide(features, members, np.full(len(features), max_k))
    if networks is not None:
        from gsmerge.networks.apply import decode_gaussians

        ones = decode_gaussians(ones, np.arange(len(features)), features, networks)
        children = decode_gaussians(children, parents, features, networks)
    return make_groups(decoding_to(ones, features), children, parents)


def make_groups(
    features: FeatureGaussians, children: Gaussians, parents: np.ndarray, learned: Learned | None = None
) -> GroupSet:
    """Make groups without fitted colours; ``parents``: rising group of each child."""
    if learned is not None:
        learned = replace(learned, refined=without_members(learned.refined))
    precision = np.zeros(len(features), np.float32)
    return GroupSet(with_child_rows(features, parents), children, features.sh0, precision, learned)


def decoding_to(ones: Gaussians, features: FeatureGaussians) -> FeatureGaussians:
    """Return Feature Gaussians that decode to the Gaussians ``ones``, without gains and latents."""
    neutral, no_latents = np.ones(len(ones), np.float32), np.zeros((len(ones), 0), np.float32)
    return replace(features, gains=neutral, latents=no_latents, **moments_of(ones))


def from_encoded(encoded: Encoded) -> OnlineState:
    """Convert an encoded scene to a state of one batch without photos."""
    ones, _ = children_of(encoded, np.ones(len(encoded), np.int64))
    children, parents = children_of(encoded, np.full(len(encoded), encoded.settings.max_k))
    groups = make_groups(decoding_to(ones, encoded.features), children, parents)
    cameras = encoded.cameras
    settings = replace(encoded.settings, target_count=None, num_slots=None)
    options = dict(encoded.about.get("options", {}))
    for name in ("fit", "device"):  # there are no photos to fit to, and this may be another machine
        options.pop(name, None)
    batch = {"num_views": len(cameras), "num_input": settings.num_input, "num_new": len(encoded)}
    batch |= {"num_covered": 0, "num_joined": 0, "num_hidden": 0, "num_groups": len(encoded)}
    about = {"gsmerge": __version__, "options": options, "batches": [batch]}
    return OnlineState(
        groups=groups,
        kept=encoded.kept,
        frame=encoded.frame,
        cameras=cameras,
        replay=no_photos(cameras),
        settings=settings,
        about=about,
    )


def moments_of(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Return the fields of Feature Gaussians with gains of one that decode to the given Gaussians."""
    scales = gaussians.scales.astype(np.float64)
    _, middle, largest = np.sort(scales, -1).T
    opacities = gaussians.opacities.astype(np.float64).clip(0, MAX_OPACITY)
    return {
        "means": gaussians.means,
        "covars": to_float32(covariances(gaussians.quats.astype(np.float64), scales)),
        "extinctions": to_float32(-log1p(-opacities) * middle * largest),
        "sh0": gaussians.sh0,
        "shN": gaussians.shN,
    }


def with_child_rows(features: FeatureGaussians, parents: np.ndarray) -> FeatureGaussians:
    """Return Feature Gaussians whose members are rows 0, 1, ... of their children; ``parents`` rise."""
    starts = np.concatenate([[0], np.bincount(parents, minlength=len(features)).cumsum()])
    return replace(features, starts=starts, members=np.arange(len(parents)))


def child_members(groups: GroupSet) -> Members:
    """Return the children of groups as members."""
    footprints = CHILD_FOOTPRINT * groups.features.footprints.repeat(np.diff(groups.features.starts))
    return gaussian_members(groups.children, footprints)


def select_groups(groups: GroupSet, rows: np.ndarray) -> GroupSet:
    """Select groups by ``rows``, with their children."""
    features = take(groups.features, rows)
    children = groups.children[features.members]
    members = np.arange(len(children))
    learned = None if groups.learned is None else groups.learned[rows]
    colors = groups.fitted_sh0[rows], groups.color_precision[rows]
    return GroupSet(replace(features, members=members), children, *colors, learned)


def concat_groups(sets: list[GroupSet]) -> GroupSet:
    """Concatenate the groups of all sets."""
    features = FeatureGaussians.concat([groups.features for groups in sets])
    children = Gaussians.concat([groups.children for groups in sets])
    learned = [groups.learned for groups in sets if groups.learned is not None]
    return GroupSet(
        replace(features, members=np.arange(len(children))),
        children,
        np.concatenate([groups.fitted_sh0 for groups in sets]),
        np.concatenate([groups.color_precision for groups in sets]),
        Learned.concat(learned) if learned else None,
    )


def limit_children(groups: GroupSet, max_k: int) -> GroupSet:
    """Pool children in groups that have more than ``max_k``."""
    rows = np.flatnonzero(np.diff(groups.features.starts) > max_k)
    if len(rows) == 0:
        return groups
    large = select_groups(groups, rows)
    children, parents = divide(large.features, child_members(large), np.full(len(large), max_k))
    pooled = replace(large, features=with_child_rows(large.features, parents), children=children)
    return replace_groups(groups, rows, pooled)


def replace_groups(groups: GroupSet, rows: np.ndarray, new_groups: GroupSet) -> GroupSet:
    """Replace the groups at ``rows`` by as many others."""
    index = np.arange(len(groups))
    index[rows] = len(groups) + np.arange(len(rows))
    return select_groups(concat_groups([groups, new_groups]), index)


def with_fitted_colors(groups: GroupSet) -> GroupSet:
    """Return groups and children in the colours fitted to the photos."""
    offsets = groups.fitted_sh0 - groups.features.sh0
    sizes = np.diff(groups.features.starts)
    features = replace(groups.features, sh0=groups.fitted_sh0)
    children = replace(groups.children, sh0=groups.children.sh0 + offsets.repeat(sizes, 0))
    return replace(groups, features=features, children=children)


def to_encoded(state: OnlineState, *, fitted_colors: bool = True) -> Encoded:
    """Convert a state to an encoded scene, in fitted colours or in those of the input files.

    With networks, decoder heads set the colours instead.
    """
    groups, heads, max_k = state.groups, None, state.settings.max_k
    if fitted_colors and state.networks is None:
        groups = with_fitted_colors(groups)
    features, members = groups.features, child_members(groups)
    if state.networks is None or groups.learned is None:
        division = divide_all(features, members, max_k)
    else:
        learned, networks = groups.learned, state.networks
        described = networks.samples.describe(learned, state.cameras)
        features, heads = learned.refined, StoredHeads(networks.weights, learned.views, described.group)
        if networks.weights.options.outputs == "absolute":
            division = divide_by_heads(features, learned.num_members, max_k)
        else:
            rows = {"starts": groups.features.starts, "members": groups.features.members}
            division = divide_all(replace(features, **rows), members, max_k)
    return Encoded(
        features=without_members(features),
        division=division,
        kept=state.kept,
        frame=state.frame,
        cameras=state.cameras,
        settings=replace(state.settings, knee_count=len(features)),
        heads=heads,
        about=state.about,
    )
