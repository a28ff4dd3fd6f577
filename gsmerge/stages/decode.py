"""Feature Gaussians -> Gaussians: K children of every group, analytic, corrected by networks if any."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gsmerge.arrays import as_array
from gsmerge.kernels.gaussians.bisect import bisect, gather_groups, split_errors
from gsmerge.networks.corrector import ANALYTIC, Corrector
from gsmerge.pooling import Members, feature_to_gaussians, pool_members, to_gaussians
from gsmerge.runtime.record import stage
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.stages import MIXED, MIXED_COUNTS, DecodeOptions
from gsmerge.stages.merge import MergedViews
from gsmerge.stages.superpixels import scene_saliency
from gsmerge.types import Decoded, FeatureGaussians, Gaussians, PicturedScene, Scene

GROUPS_PER_TASK = 8192
REFILLS = 3  # times that Gaussians too faint to be seen are replaced by others, of which a few are faint again
PLANE_WEIGHT = 1 / 16  # of squared distances from a group's plane; the unit is that of the children's features


def decode(
    features: FeatureGaussians,
    members: Members,
    options: DecodeOptions,
    counts: np.ndarray | None = None,
    networks: Corrector = ANALYTIC,
) -> Gaussians:
    """Decode each Feature Gaussian into K Gaussians, fewer if its members are alike.

    Children are found by halving the members repeatedly across their widest direction in colour and position, so the
    children of K = 2 are unions of those of K = 4; heads with absolute outputs make exactly K of every group.
    ``counts [g]``, from 1 on, sets K for each group and is required for mixed K. Gaussians of one group are adjacent.
    """
    if counts is None:
        counts = np.full(len(features), options.max_k)
    if counts.shape != (len(features),) or counts.min(initial=1) < 1:
        raise ValueError(f"counts: expected {len(features)} numbers from 1 on, got shape {list(counts.shape)}")
    children, parents = repeat(features, counts) if networks.makes_children else divide(features, members, counts)
    gaussians = networks.decode(children, parents, features)
    return gaussians[gaussians.opacities >= options.min_opacity]


def keep_all(scene: Scene, count: int | None) -> Decoded | None:
    """Return all Gaussians of a scene if at least as many are asked for; otherwise None."""
    if count is None or count < len(scene.gaussians):
        return None
    return Decoded(scene.gaussians, len(scene.gaussians), exact=True, is_input=True)


@stage("decode")
def decode_merged(merged: MergedViews, scene: PicturedScene, options: DecodeOptions, *, grows: bool) -> Decoded:
    """Decode merged views into the exact count, unless the fit ``grows`` to it, or into K Gaussians per group."""
    asked = merged.segmentation
    if asked.exact and not grows:
        gaussians = _decode_exactly(merged, asked.count, options)
    else:
        gaussians = _decode_count(merged, scene, merged_count(merged, options, grows=grows), options)
        if asked.exact and len(gaussians) > asked.count:  # K each would be more than the fit may grow to
            gaussians = _decode_count(merged, scene, asked.count, options)
    return Decoded(gaussians, asked.count, asked.exact)


def _decode_count(merged: MergedViews, scene: PicturedScene, count: int | None, options: DecodeOptions) -> Gaussians:
    """Decode ``count`` Gaussians where they lower distortion most; None: K per Feature Gaussian."""
    features, members, networks = merged.features, merged.members, merged.networks
    children = None
    if count is not None:
        children = split_counts(features, members, max(0, count - len(features)), networks.max_children)
    elif options.k == MIXED:
        children = mixed_counts(features, members, scene_saliency(scene.images), options)
    return decode(features, members, options, children, networks=networks)


def _decode_exactly(merged: MergedViews, count: int, options: DecodeOptions) -> Gaussians:
    """Decode ``count`` visible Gaussians where they lower distortion most."""
    features, members, networks = merged.features, merged.members, merged.networks
    every = replace(options, min_opacity=0.0)
    return deal_visible(
        deal_order(features, members, networks.max_children),
        len(features),
        count,
        options.min_opacity,
        lambda counts: decode(features, members, every, counts, networks=networks),
    )


def deal_visible(
    order: np.ndarray, num_groups: int, total: int, min_opacity: float, make: Callable[[np.ndarray], Gaussians]
) -> Gaussians:
    """Make ``total`` visible Gaussians; those fainter than ``min_opacity`` are replaced by children of other groups.

    ``order [d]`` are the groups of further Gaussians, see :func:`deal_order`; each group gets at least one. ``make``
    makes Gaussians, faint ones included, from the number for each group ``[g]``. There are fewer than ``total`` if the
    groups cannot be divided into as many.
    """
    extra = max(0, total - num_groups)
    for _ in range(REFILLS + 1):
        gaussians = make(1 + np.bincount(order[:extra], minlength=num_groups))
        missing = total - int((gaussians.opacities >= min_opacity).sum())
        if missing <= 0 or extra >= len(order):
            break
        extra += missing
    if len(gaussians) <= total:
        return gaussians
    most_opaque = np.argsort(-as_array(gaussians.opacities), kind="stable")[:total]  # the last few may be faint
    return gaussians[np.sort(most_opaque)]


def mixed_counts(
    features: FeatureGaussians, members: Members, saliency: np.ndarray, options: DecodeOptions
) -> np.ndarray:
    """Choose K = 1, 2 or 4 for every group by its rank in ``saliency`` (paper supplement, per-superpixel K)."""
    counts = counts_by_saliency(group_saliency(features, members, saliency), options)
    if options.k_rule == "distortion":
        return split_counts(features, members, int((counts - 1).sum()), MIXED_COUNTS[-1])
    return counts


def group_saliency(features: FeatureGaussians, members: Members, saliency: np.ndarray) -> np.ndarray:
    """Average the saliency of all views' pixels over each group's members, ``[g]``; without a pixel it is 0."""
    starts, pixels = features.starts, members.pixels[features.members]
    values = np.where(pixels >= 0, saliency[pixels], 0.0)
    return np.add.reduceat(values, starts[:-1]) / np.diff(starts) if len(features) else np.zeros(0)


def counts_by_saliency(saliency: np.ndarray, options: DecodeOptions) -> np.ndarray:
    """Return K = 1, 2 or 4 for every group by the rank of its saliency ``[g]``."""
    low, high = np.percentile(saliency, (options.k_low, options.k_high)) if len(saliency) else (0.0, 0.0)
    counts: np.ndarray = 1 + (saliency > low) + 2 * (saliency > high)
    return counts


def merged_count(merged: MergedViews, options: DecodeOptions, *, grows: bool) -> int | None:
    """Return the number of Gaussians to decode merged views into; None: K for each Feature Gaussian.

    It is a number if an exact count is requested and no fit grows to it, and where superpixels are empty, unless heads
    make K of every group: a Gaussian that a near and a far view show belongs to the near one, so superpixels of the far
    view may have none, and their Gaussians go to other groups.
    """
    segmentation, num_empty = merged.segmentation, len(merged.segmentation.groups) - merged.num_groups
    if segmentation.exact and not grows:
        return segmentation.count
    if num_empty == 0 or options.k == MIXED or merged.networks.makes_children:
        return None
    return min(segmentation.count, options.max_k * (len(merged.features) + num_empty))


def repeat(features: FeatureGaussians, counts: np.ndarray) -> tuple[Gaussians, np.ndarray]:
    """Return every Feature Gaussian as ``counts [g]`` equal Gaussians for heads to replace, and the group of each."""
    parents = np.repeat(np.arange(len(features)), counts)
    return feature_to_gaussians(features)[parents], parents


def divide(features: FeatureGaussians, members: Members, counts: np.ndarray) -> tuple[Gaussians, np.ndarray]:
    """Return the children that :func:`decode` makes without networks, faint ones too, and the group ``[n]`` of each."""
    divided = counts > 1
    gaussians, parents = feature_to_gaussians(features), np.arange(len(features))
    if divided.any():
        starts, ids, of_children = halve(features, members, np.flatnonzero(divided), counts)
        moments = pool_members(members, starts, ids)
        extinctions = moments.extinctions * features.gains[of_children]
        children = to_gaussians(moments.covars, extinctions, moments.means, moments.sh)
        whole = np.flatnonzero(~divided)
        parents = np.concatenate([whole, of_children])
        order = np.argsort(parents, kind="stable")
        parents = parents[order]
        gaussians = Gaussians.concat([gaussians[whole], children])[order]
    return gaussians, parents


def halve(
    features: FeatureGaussians, members: Members, groups: np.ndarray, counts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Halve the members of groups into ``counts [g]`` children: starts ``[n+1]``, members ``[m]``, groups ``[n]``."""
    starts, ids = features.starts, features.members
    centres, footprints = features.means.astype(np.float64), features.footprints.astype(np.float64)

    def run(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        local, group = gather_groups(starts, ids, rows)
        m = members
        child_starts, child_ids, parents = bisect(
            local, group, m.means, m.sh0, m.opacities, centres[rows], footprints[rows], counts[rows]
        )
        return np.diff(child_starts), child_ids, rows[parents]

    parts = parallel_map(run, [groups[i : i + GROUPS_PER_TASK] for i in range(0, len(groups), GROUPS_PER_TASK)])
    sizes, child_ids, parents = (np.concatenate(column) for column in zip(*parts, strict=True))
    return np.concatenate([[0], np.cumsum(sizes)]), child_ids, parents


def split_counts(features: FeatureGaussians, members: Members, extra: int, max_children: int = 8) -> np.ndarray:
    """Give ``extra`` Gaussians to the groups where they lower distortion most; return the children ``[g]`` per group.

    A step that only pays together with the next step is judged by the two together (the convex hull of the group's
    distortion), so a larger ``extra`` never removes a child. The sum is ``g + extra``, or the largest number that the
    members give.
    """
    if extra < 0:
        raise ValueError(f"extra: expected at least 0, got {extra}")
    if max_children < 1:
        raise ValueError(f"max_children: expected at least 1, got {max_children}")
    if extra == 0:
        return np.ones(len(features), np.int64)
    return 1 + np.bincount(deal_order(features, members, max_children)[:extra], minlength=len(features))


def deal_order(features: FeatureGaussians, members: Members, max_children: int = 8) -> np.ndarray:
    """Return the order in which groups get further Gaussians: the group ``[d]`` of each, the largest gain first."""
    if max_children == 1 or len(features) == 0:
        return np.zeros(0, np.int64)
    gains = hull_gains(_child_errors(features, members, max_children))
    # Stable, group by group: of equal gains of one group the first step comes first.
    order = np.argsort(-gains.reshape(-1), kind="stable")
    return order[: int(np.isfinite(gains).sum())] // gains.shape[1]


def _child_errors(features: FeatureGaussians, members: Members, max_children: int) -> np.ndarray:
    """Return the distortion ``[g,max_children]`` of 1, 2, ... children; NaN where members give fewer."""
    starts, ids = features.starts, features.members
    centres, footprints = features.means.astype(np.float64), features.footprints.astype(np.float64)

    def run(rows: np.ndarray) -> np.ndarray:
        local, group = gather_groups(starts, ids, rows)
        m = members
        return split_errors(
            local, group, m.means, m.sh0, m.opacities, centres[rows], footprints[rows], max_children, PLANE_WEIGHT
        )

    every = np.arange(len(features))
    tasks = [every[i : i + GROUPS_PER_TASK] for i in range(0, len(every), GROUPS_PER_TASK)]
    return np.concatenate(parallel_map(run, tasks))


def hull_gains(errors: np.ndarray) -> np.ndarray:
    """Return the gain ``[f,c-1]`` of each further child, along the lower convex hull of the errors ``[f,c]``.

    It is -inf where there is no child. Along the hull the gains fall from child to child.
    """
    num_groups, num_children = errors.shape
    gains = np.full((num_groups, num_children - 1), -np.inf)
    at, rows = np.zeros(num_groups, int), np.arange(num_groups)
    for _ in range(num_children - 1):
        steps = np.arange(num_children)[None] - at[:, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            slopes = np.where(steps > 0, (errors[rows, at][:, None] - errors) / steps, -np.inf)
        slopes = np.where(np.isnan(slopes), -np.inf, slopes)
        best = num_children - 1 - np.argmax(slopes[:, ::-1], axis=1)
        slope = slopes[rows, best]
        for child in range(1, num_children):
            fill = np.isfinite(slope) & (child > at) & (child <= best)
            gains[fill, child - 1] = slope[fill]
        at = np.where(np.isfinite(slope), best, at)
    return gains
