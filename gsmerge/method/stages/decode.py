"""Feature Gaussians -> Gaussians: make K children of every group by closed formulas, which networks may correct."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gsmerge.arrays import as_array
from gsmerge.method.geometry.pooling import Members, feature_to_gaussians, pool_members, to_gaussians
from gsmerge.method.kernels.gaussians.pool import bisect, gather_groups, split_errors
from gsmerge.method.networks.corrector import ANALYTIC, Corrector
from gsmerge.method.stages.merge import MergedViews
from gsmerge.method.stages.superpixels import scene_saliency
from gsmerge.runtime.record import stage
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.stages import MIXED, MIXED_COUNTS, DecodeOptions
from gsmerge.types import Decoded, FeatureGaussians, Gaussians, PicturedScene

GROUPS_PER_TASK = 8192  # number of groups that a thread divides at a time
PLANE_WEIGHT = 1 / 16  # weight of squared distances from a child's plane, relative to squared differences of colour


def decode(
    features: FeatureGaussians,
    members: Members,
    options: DecodeOptions,
    counts: np.ndarray | None = None,
    networks: Corrector = ANALYTIC,
) -> Gaussians:
    """Decode each Feature Gaussian into K Gaussians, which are its children.

    The members are halved repeatedly across their widest direction in colour and position, and each part becomes a
    child. So the two children for K = 2 are unions of the four children for K = 4. Members with the same position and
    colour cannot be halved, so their group has fewer children. Networks with absolute outputs do not halve, but make
    exactly K children of every group. ``counts [g]`` has a K of at least 1 for each group. Without ``counts``, K is
    ``options.max_k``. The children of a group are adjacent. Children that are fainter than ``options.min_opacity`` are
    left out.
    """
    if counts is None:
        counts = np.full(len(features), options.max_k)
    if counts.shape != (len(features),) or counts.min(initial=1) < 1:
        raise ValueError(f"counts: expected {len(features)} numbers from 1 on, got shape {list(counts.shape)}")
    children, parents = (
        repeat_groups(features, counts) if networks.makes_children else divide_groups(features, members, counts)
    )
    gaussians = networks.decode(children, parents, features)
    return gaussians[gaussians.opacities >= options.min_opacity]


@stage("decode")
def decode_merged(merged: MergedViews, scene: PicturedScene, options: DecodeOptions, *, grows: bool) -> Decoded:
    """Decode merged views into the Gaussians that a fit starts from.

    If an exact number was requested, this number of visible Gaussians is made, unless the fit ``grows`` to it later. In
    all other cases each group gets K Gaussians. A superpixel has no members if its Gaussians belong to a nearer view,
    and other groups get the K Gaussians of this superpixel. Heads that make exactly K Gaussians of every group cannot
    make more for other groups.
    """
    features = merged.features
    members = merged.members
    networks = merged.networks
    count = merged.segmentation.count
    exact = merged.segmentation.exact
    if exact and not grows:
        with_faint = replace(options, min_opacity=0.0)
        gaussians = deal_visible(
            deal_order(features, members, networks.max_children),
            len(features),
            count,
            options.min_opacity,
            lambda counts: decode(features, members, with_faint, counts, networks=networks),
        )
        return Decoded(gaussians, count, exact)
    num_empty = len(merged.segmentation.groups) - merged.num_groups
    num_made: int | None = None  # K of each Feature Gaussian
    if num_empty and options.k != MIXED and not networks.makes_children:
        num_made = min(count, options.max_k * (len(features) + num_empty))
    gaussians = _decode_count(merged, scene, num_made, options)
    if exact and len(gaussians) > count:  # K per group exceed the number that the fit may grow to
        gaussians = _decode_count(merged, scene, count, options)
    return Decoded(gaussians, count, exact)


def _decode_count(merged: MergedViews, scene: PicturedScene, count: int | None, options: DecodeOptions) -> Gaussians:
    """Decode ``count`` Gaussians, or K of each Feature Gaussian if ``count`` is None.

    More Gaussians go to groups in which they lower distortion most. Faint Gaussians are left out, so the result may
    have fewer than ``count``.
    """
    features = merged.features
    members = merged.members
    networks = merged.networks
    children = None
    if count is not None:
        children = split_counts(features, members, max(0, count - len(features)), networks.max_children)
    elif options.k == MIXED:
        children = mixed_counts(features, members, scene_saliency(scene.images), options)
    return decode(features, members, options, children, networks=networks)


def deal_visible(
    order: np.ndarray, num_groups: int, total: int, min_opacity: float, make: Callable[[np.ndarray], Gaussians]
) -> Gaussians:
    """Make ``total`` Gaussians that are visible, so not fainter than ``min_opacity``.

    Each group gets one Gaussian. Further Gaussians go to the groups in the list ``order [d]``, see :func:`deal_order`.
    ``make`` makes the given number of Gaussians ``[g]`` for each group. For each Gaussian that is too faint, one more
    group in the list gets a Gaussian. The result has fewer than ``total`` Gaussians if the groups have too few members.
    """
    extra = max(0, total - num_groups)
    max_retries = 3  # most rounds that replace faint Gaussians, of which a few are faint again
    for _ in range(max_retries + 1):
        gaussians = make(1 + np.bincount(order[:extra], minlength=num_groups))
        missing = total - int((gaussians.opacities >= min_opacity).sum())
        if missing <= 0 or extra >= len(order):
            break
        extra += missing
    if len(gaussians) <= total:
        return gaussians
    most_opaque = np.argsort(-as_array(gaussians.opacities), kind="stable")[:total]  # some may still be faint
    return gaussians[np.sort(most_opaque)]


def mixed_counts(
    features: FeatureGaussians, members: Members, saliency: np.ndarray, options: DecodeOptions
) -> np.ndarray:
    """Choose K for every group, 1 to 4, by the rule of the options (paper supplement, per-superpixel K).

    ``saliency`` has a number for every pixel of all views. One rule ranks groups by their saliency. The rule
    "distortion" makes as many Gaussians in all as the rule by saliency, but more of them where they lower distortion
    most.
    """
    counts = counts_by_saliency(group_saliency(features, members, saliency), options)
    if options.k_rule == "distortion":
        return split_counts(features, members, int((counts - 1).sum()), MIXED_COUNTS[-1])
    return counts


def group_saliency(features: FeatureGaussians, members: Members, saliency: np.ndarray) -> np.ndarray:
    """Return the mean saliency ``[g]`` of the pixels of each group's members, with 0 for members without a pixel."""
    starts = features.starts
    pixels = members.pixels[features.members]
    values = np.where(pixels >= 0, saliency[pixels], 0.0)
    return np.add.reduceat(values, starts[:-1]) / np.diff(starts) if len(features) else np.zeros(0)


def counts_by_saliency(saliency: np.ndarray, options: DecodeOptions) -> np.ndarray:
    """Return a K of 1, 2 or 4 for groups whose ``saliency [g]`` is below, between or above two percentiles of it."""
    low, high = np.percentile(saliency, (options.k_low, options.k_high)) if len(saliency) else (0.0, 0.0)
    counts: np.ndarray = 1 + (saliency > low) + 2 * (saliency > high)
    return counts


def repeat_groups(features: FeatureGaussians, counts: np.ndarray) -> tuple[Gaussians, np.ndarray]:
    """Repeat each Feature Gaussian ``counts [g]`` times, for heads that make all children themselves.

    Returns the Gaussians, and the group ``[n]`` of each.
    """
    parents = np.repeat(np.arange(len(features)), counts)
    return feature_to_gaussians(features)[parents], parents


def divide_groups(features: FeatureGaussians, members: Members, counts: np.ndarray) -> tuple[Gaussians, np.ndarray]:
    """Divide each Feature Gaussian into at most ``counts [g]`` children, by repeated halving of its members.

    Returns the children, faint ones included, and the group ``[n]`` of each child, ascending.
    """
    is_divided = counts > 1
    gaussians = feature_to_gaussians(features)
    if not is_divided.any():
        return gaussians, np.arange(len(features))
    centres, footprints = features.means.astype(np.float64), features.footprints.astype(np.float64)

    def halve_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the sizes, the members and the groups of the children of the groups ``rows``."""
        row_starts, row_ids = gather_groups(features.starts, features.members, rows)
        m = members
        child_starts, child_ids, child_rows = bisect(
            row_starts, row_ids, m.means, m.sh0, m.opacities, centres[rows], footprints[rows], counts[rows]
        )
        return np.diff(child_starts), child_ids, rows[child_rows]

    parts = parallel_map(halve_rows, _tasks_of(np.flatnonzero(is_divided)))
    sizes, ids, child_parents = (np.concatenate(column) for column in zip(*parts, strict=True))
    moments = pool_members(members, np.concatenate([[0], np.cumsum(sizes)]), ids)
    extinctions = moments.extinctions * features.gains[child_parents]
    children = to_gaussians(moments.covars, extinctions, moments.means, moments.sh)
    undivided = np.flatnonzero(~is_divided)
    parents = np.concatenate([undivided, child_parents])
    order = np.argsort(parents, kind="stable")
    return Gaussians.concat([gaussians[undivided], children])[order], parents[order]


def _tasks_of(groups: np.ndarray) -> list[np.ndarray]:
    """Split a list of groups into tasks for the threads."""
    return [groups[i : i + GROUPS_PER_TASK] for i in range(0, len(groups), GROUPS_PER_TASK)]


def split_counts(features: FeatureGaussians, members: Members, extra: int, max_children: int = 8) -> np.ndarray:
    """Return the number of children ``[g]`` of each group, if there are ``extra`` children more than groups.

    Each group has at least one child. Further children go to groups in which they lower distortion most, as far as the
    members suffice. If a child lowers distortion only together with the next child, both count with their mean gain,
    which is a slope of the convex hull of the group's distortion. As gains fall along a convex hull, no group loses a
    child if ``extra`` grows.
    """
    if extra < 0:
        raise ValueError(f"extra: expected at least 0, got {extra}")
    if max_children < 1:
        raise ValueError(f"max_children: expected at least 1, got {max_children}")
    if extra == 0:
        return np.ones(len(features), np.int64)
    return 1 + np.bincount(deal_order(features, members, max_children)[:extra], minlength=len(features))


def deal_order(features: FeatureGaussians, members: Members, max_children: int = 8) -> np.ndarray:
    """Return the list ``[d]`` of groups to which further children go, the child with the largest gain first.

    The list contains a group once for each child after its first.
    """
    if max_children == 1 or len(features) == 0:
        return np.zeros(0, np.int64)
    centres, footprints = features.means.astype(np.float64), features.footprints.astype(np.float64)

    def measure_rows(rows: np.ndarray) -> np.ndarray:
        """Return the distortions of the groups ``rows`` with 1, 2 and more children, NaN for more than members."""
        row_starts, row_ids = gather_groups(features.starts, features.members, rows)
        m = members
        return split_errors(
            row_starts, row_ids, m.means, m.sh0, m.opacities, centres[rows], footprints[rows], max_children,
            PLANE_WEIGHT,
        )  # fmt: skip

    gains = hull_gains(np.concatenate(parallel_map(measure_rows, _tasks_of(np.arange(len(features))))))
    # The order is stable, so that among equal gains of one group the first child comes first
    order = np.argsort(-gains.reshape(-1), kind="stable")
    return order[: int(np.isfinite(gains).sum())] // gains.shape[1]


def hull_gains(errors: np.ndarray) -> np.ndarray:
    """Return how much each further child of a group lowers its error, ``[g,c-1]``.

    ``errors [g,c]`` are the errors of g groups with 1, 2 and more children. The gains are slopes of the lower convex
    hull of the errors, so they fall from child to child. The gain of a child that cannot exist is -inf.
    """
    num_groups, num_children = errors.shape
    gains = np.full((num_groups, num_children - 1), -np.inf)
    # `corner` is, for each group, the position in its errors of the last corner of its convex hull so far
    corner = np.zeros(num_groups, int)
    rows = np.arange(num_groups)
    for _ in range(num_children - 1):
        steps = np.arange(num_children)[None] - corner[:, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            slopes = np.where(steps > 0, (errors[rows, corner][:, None] - errors) / steps, -np.inf)
        slopes = np.where(np.isnan(slopes), -np.inf, slopes)
        next_corner = num_children - 1 - np.argmax(slopes[:, ::-1], axis=1)
        slope = slopes[rows, next_corner]
        for child in range(1, num_children):
            is_between = np.isfinite(slope) & (child > corner) & (child <= next_corner)
            gains[is_between, child - 1] = slope[is_between]
        corner = np.where(np.isfinite(slope), next_corner, corner)
    return gains
