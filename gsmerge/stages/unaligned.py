"""What a scene needs before its Gaussians can be grouped, and what groups need of it, in order or not.

A scene with one Gaussian per pixel is ready. One in no order may lack cameras, which are then placed, and photos,
which are then rendered from the scene itself; the Gaussians that no view sees are set aside if they are to be kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from gsmerge.budget import exact_count
from gsmerge.errors import UsageError
from gsmerge.geometry import morton_codes
from gsmerge.moments import Members, pool_members, scene_members, unaligned_members
from gsmerge.options import CompactOptions
from gsmerge.render import render
from gsmerge.stages.assign import find_owners, owner_pixels, seen_weights
from gsmerge.stages.decode import DecodeOptions, decode
from gsmerge.stages.encode import from_moments
from gsmerge.stages.group import Grouping
from gsmerge.stages.place_cameras import place_cameras
from gsmerge.stages.prepare import Frame, canonicalise
from gsmerge.types import FeatureGaussians, Gaussians, Groups, PixelScene, UnalignedScene
from gsmerge.views import distinct_views, subset


@dataclass(frozen=True)
class ReadyScene:
    """A scene that the stages can work on.

    Args:
        scene: Canonical; without an order it has cameras, images, and only finite Gaussians.
        frame: The canonical frame.
        options: With any budget less what is kept aside.
        kept: Gaussians for what no view sees, merged already, canonical; None without any.
        notes: What was missing and what stands in for it, one sentence each.
    """

    scene: PixelScene | UnalignedScene
    frame: Frame
    options: CompactOptions
    kept: Gaussians | None
    notes: tuple[str, ...]


def make_ready(scene: PixelScene | UnalignedScene, options: CompactOptions, frame: Frame | None = None) -> ReadyScene:
    """The scene in its canonical frame, or in a given one, with everything that it lacked.

    Raises:
        ValueError: If there is no finite Gaussian, or there are images without cameras.
    """
    scene, options, repeats = without_repeats(scene, options)
    if isinstance(scene, PixelScene):
        canonical, frame = canonicalise(scene, frame)
        return ReadyScene(canonical, frame, options, None, tuple(repeats))
    whole, notes = with_cameras(scene)
    notes = [*repeats, *notes]
    loose, frame = canonicalise(whole, frame)
    kept = None
    if options.contribution.unseen == "keep":
        loose, options, kept = set_aside(loose, options)
        notes += [f"{len(whole.gaussians) - len(loose.gaussians)} Gaussians that no view sees are kept, merged"]
    if loose.images is None:
        loose = replace(loose, images=render(loose.gaussians, loose.cameras).images.clamp(0, 1))
        notes.append("no photos: views rendered from the scene itself stand in for them")
    return ReadyScene(loose, frame, options, kept, tuple(notes))


def without_repeats(
    scene: PixelScene | UnalignedScene, options: CompactOptions
) -> tuple[PixelScene | UnalignedScene, CompactOptions, list[str]]:
    """The scene with every view once, the options with budgets that stay shares of the whole, and a note of it."""
    views = distinct_views(scene)
    if len(views) == len(scene):
        return scene, options, []
    few = subset(scene, views)
    wanted = exact_count(options.target, scene.num_gaussians, scene.gaussians.sh_degree)
    if wanted is not None:
        target = replace(options.target, budget=min(wanted, few.num_gaussians), max_bytes=None)
        options = replace(options, target=target)
    return few, options, [f"{len(scene) - len(views)} views repeat others in every pixel and count once"]


def with_views(scene: PixelScene | UnalignedScene) -> tuple[PixelScene | UnalignedScene, list[str]]:
    """:func:`with_cameras` for a scene of either kind; one with pixels has its cameras."""
    return (scene, []) if isinstance(scene, PixelScene) else with_cameras(scene)


def with_cameras(scene: UnalignedScene) -> tuple[UnalignedScene, list[str]]:
    """The finite Gaussians, and cameras where there are none.

    Raises:
        ValueError: If there is no finite Gaussian, or there are images without cameras.
    """
    g, notes = scene.gaussians, []
    finite = torch.isfinite(g.opacities)
    for tensor in (g.means, g.quats, g.scales, g.sh0, g.shN):
        finite &= torch.isfinite(tensor).flatten(1).all(1)
    count = int((~finite).sum())
    if count == len(g):
        raise ValueError("expected at least one finite Gaussian, got none")
    if count:
        notes.append(f"{count} Gaussians are not finite and were left out")
        scene = replace(scene, gaussians=g[finite])
    if len(scene) == 0:
        cameras = place_cameras(scene.gaussians)
        names = tuple(f"placed {view}" for view in range(len(cameras)))
        scene = UnalignedScene(scene.gaussians, cameras, None, names)
        notes.append(f"no cameras: {len(cameras)} placed around and inside the scene, where they show most of it")
    return scene, notes


def set_aside(
    scene: UnalignedScene, options: CompactOptions
) -> tuple[UnalignedScene, CompactOptions, Gaussians | None]:
    """What some view sees; the options with the rest of the budget; and what no view sees, merged at the same rate."""
    weights = seen_weights(scene)
    seen = torch.from_numpy((weights > 0) & (weights >= options.contribution.min_contribution))
    share = 1 - float(seen.double().mean())
    if share in (0, 1):
        return scene, options, None
    wanted = exact_count(options.target, len(seen), scene.gaussians.sh_degree)
    rate = options.segment.density * options.decode.count if wanted is None else wanted / len(seen)
    hidden = scene.gaussians[~seen & (scene.gaussians.opacities >= options.decode.min_opacity)]
    count = min(len(hidden), int(rate * int((~seen).sum())))
    if wanted is not None:
        rest = replace(options.target, budget=max(1, wanted - count), max_bytes=None)
        options = replace(options, target=rest)
    kept = merge_neighbours(hidden, scene, count, options) if count else None
    return replace(scene, gaussians=scene.gaussians[seen]), options, kept


def merge_neighbours(gaussians: Gaussians, scene: UnalignedScene, count: int, options: CompactOptions) -> Gaussians:
    """At most ``count`` Gaussians in place of n >= count: runs along a space-filling curve (Morton's) are merged."""
    order = np.argsort(morton_codes(gaussians.means.double().numpy()), kind="stable")
    hidden = replace(scene, gaussians=gaussians)
    members = unaligned_members(hidden, np.full(len(gaussians), -1, np.int64))
    starts = np.linspace(0, len(order), count + 1).astype(np.int64)
    moments = pool_members(members, starts, order, options.encode.rule)
    features = from_moments(moments, starts, order, np.full(count, -1))
    return decode(features, members, DecodeOptions(min_opacity=0.0))


def members_of(scene: PixelScene | UnalignedScene, groups: Groups, options: CompactOptions) -> Members:
    """The scene's Gaussians as arrays; of a scene in no order, each with a pixel of the superpixel it adds most to.

    Raises:
        UsageError: If no view sees any Gaussian.
    """
    if isinstance(scene, PixelScene):
        return scene_members(scene)
    pixels = owner_pixels(find_owners(scene, groups), groups, options.contribution.min_contribution)
    if not (pixels >= 0).any():
        raise UsageError(
            f"expected views that see the scene, found that none of {len(scene)} sees any of {len(pixels)} Gaussians: "
            "give the cameras that belong to it"
        )
    return unaligned_members(scene, pixels)


def unaligned_count(
    features: FeatureGaussians, members: Members, grouping: Grouping, options: CompactOptions
) -> int | None:
    """Gaussians that the groups of a scene in no order should become; None for one in order: K for each group.

    What a near and a far view both show belongs to the near one, so many superpixels of the far one stay empty. Their
    Gaussians are spent on the others.
    """
    if members.pixels is None:
        return None
    groups = grouping.groups
    sizes = np.array(groups.counts)
    seen = members.pixels[members.pixels >= 0]
    labels = groups.labels.reshape(-1).numpy()[seen] + (np.cumsum(sizes) - sizes)[seen // groups.labels[0].numel()]
    num_filled = int((np.bincount(labels, minlength=len(groups)) > 0).sum())
    return min(grouping.wanted, options.decode.count * (len(features) + len(groups) - num_filled))
