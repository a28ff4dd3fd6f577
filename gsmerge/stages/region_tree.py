"""How many Gaussians to spend, and where: superpixels merged where little is lost, split where much is gained.

Distortion lives in image space: squared colour error plus the squared error of the depth relative to a plane, so
that a flat wall costs nothing from any angle and far things count no less than near ones. All views of a scene
share one threshold, so every Gaussian buys about the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsmerge.kernels.gaussians.bisect import gather_groups, split_errors
from gsmerge.kernels.superpixels.region_tree import OVERSIZE, PLANE_ERROR, ROW, cut_labels, merge_order, region_sums
from gsmerge.kernels.superpixels.regions import pad_labels
from gsmerge.kernels.superpixels.ward import adjacent_pairs
from gsmerge.moments import Members
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import FeatureGaussians, Groups, PixelScene

DEPTH_RANGE = 1e3  # depths are held within this factor of the view's median
GROUPS_PER_TASK = 8192
PLANE_WEIGHT = 1 / 16  # of squared distances from a group's plane; the unit is that of the children's features
KNEE_STEP = 1.25  # the slope of the curve is taken over this factor of the count


@dataclass(frozen=True)
class AllocateOptions:
    """What a good place for a Gaussian is, and when more are not worth it.

    Args:
        depth_weight: Of squared relative depth errors against squared colour errors (sRGB in [0, 1]).
        region_compactness: Of squared pixels against squared colours while regions merge; without it they become
            snakes that no Gaussian fits.
        max_extent: Largest side of a region, as a share of the image's longer side: the rasterizer's affine
            approximation bends larger Gaussians. Exceeded only when the budget leaves no other choice.
        knee_slope: The automatic count stops where the predicted quality grows by less than this, dB per
            relative increase of the count (1 means 0.01 dB per 1 % more).
        knee_floor: Squared error per pixel and channel that no count removes (noise, views that disagree).
    """

    depth_weight: float = 1.0
    region_compactness: float = 1e-5
    max_extent: float = 1 / 8
    knee_slope: float = 1.0
    knee_floor: float = 3e-4

    def __post_init__(self) -> None:
        for name in ("depth_weight", "region_compactness", "knee_slope"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: expected a number of at least 0, got {getattr(self, name)}")
        if not self.max_extent > 0:
            raise ValueError(f"max_extent: expected a positive number, got {self.max_extent}")
        if not self.knee_floor > 0:
            raise ValueError(f"knee_floor: expected a positive number, got {self.knee_floor}")


@dataclass(frozen=True, eq=False)
class RegionTree:
    """The merges of the superpixels of all views, from the finest to one per view, and in which order to make them.

    Args:
        groups: The superpixels that it starts from.
        parents: Per view ``[2·leaves-1]`` int32: the region that a region is merged into, -1 for the whole view.
        order: ``[m]`` int64, all merges, cheapest first; those of view v are numbered from ``first[v]`` on.
        first: ``[v+1]`` int64, merges in the views before.
        distortions: ``[m+1]`` float64, mean squared error per pixel and colour channel after the first i merges.
        least: Fewest regions before any is larger than ``max_extent``.
    """

    groups: Groups
    parents: tuple[np.ndarray, ...]
    order: np.ndarray
    first: np.ndarray
    distortions: np.ndarray
    least: int

    def __len__(self) -> int:
        """Superpixels at the start."""
        return len(self.groups)

    @property
    def counts(self) -> np.ndarray:
        """``[m+1]`` regions left after the first i merges."""
        return len(self) - np.arange(len(self.distortions))


def pixel_depths(scene: PixelScene) -> Tensor:
    """``[v,h,w]`` float32 depth of every pixel's Gaussian in its own view, world units."""
    cameras, means = scene.cameras, scene.gaussians.means
    height, width, pixels = cameras.height, cameras.width, scene.pixels_per_view

    def one_view(view: int) -> Tensor:
        third = cameras.viewmats[view, 2].to(means.dtype)
        return (means[view * pixels : (view + 1) * pixels] @ third[:3] + third[3]).float().reshape(height, width)

    return torch.stack(parallel_map(one_view, range(len(scene))))


def region_tree(
    images: Tensor, depths: Tensor, groups: Groups, valid: Tensor, options: AllocateOptions | None = None
) -> RegionTree:
    """Merge neighbouring superpixels in order of the distortion that it adds, each view down to a single region.

    Args:
        images: ``[v,h,w,3]`` float, sRGB in [0, 1].
        depths: ``[v,h,w]`` float, depth of each pixel; those of at most 0 are taken as very near.
        groups: The superpixels to start from, 4-connected, none empty.
        valid: ``[v,h,w]`` bool; pixels that do not count. Superpixels without a valid pixel merge first.
        options: Weights.

    Raises:
        ValueError: If the shapes do not fit together or a superpixel has no pixel.
    """
    options = options or AllocateOptions()
    _check_pictures(images, depths, groups, valid)
    extent = max(1.0, options.max_extent * max(images.shape[1:3]))

    def one_view(view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, int]:
        usable = _usable_depths(depths[view].numpy(), valid[view].numpy())
        labels, count = pad_labels(groups.labels[view].numpy()), groups.counts[view]
        pixels = np.ascontiguousarray(images[view].numpy(), np.float32)
        rows = np.empty((2 * count, ROW))
        weight = options.depth_weight
        start = region_sums(labels, pixels, usable, count, rows) + weight * float(rows[:count, PLANE_ERROR].sum())
        pairs = adjacent_pairs(labels)
        return *merge_order(pairs, rows, weight, options.region_compactness, extent), start, int((usable > 0).sum())

    parents, of_view, growths, starts, num_pixels = zip(*parallel_map(one_view, range(len(images))), strict=True)
    first, heights = np.concatenate([[0], np.cumsum([len(h) for h in of_view])]), np.concatenate(of_view)
    # Heights never fall from child to parent and children come first, so a stable sort keeps them in front.
    order = np.argsort(heights, kind="stable")
    added = np.concatenate([[sum(starts)], np.concatenate(growths)[order]])
    distortions = np.cumsum(added) / (3 * max(sum(num_pixels), 1))
    least = len(groups) - int(np.count_nonzero(heights < OVERSIZE))
    return RegionTree(groups, parents, order, first, distortions, least)


def _check_pictures(images: Tensor, depths: Tensor, groups: Groups, valid: Tensor) -> None:
    shape = list(groups.labels.shape)
    for name, tensor, want in (("images", images, [*shape, 3]), ("depths", depths, shape), ("valid", valid, shape)):
        if list(tensor.shape) != want:
            raise ValueError(f"{name}: expected shape {want}, got {list(tensor.shape)}")
    for view, count in enumerate(groups.counts):
        sizes = torch.bincount(groups.labels[view].reshape(-1), minlength=count)
        if len(sizes) > count or int(sizes.min()) < 1:
            raise ValueError(f"groups: expected {count} superpixels with pixels in view {view}")


def _usable_depths(depths: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Depths in units of their median, float32; 0 for pixels that do not count."""
    usable = valid & np.isfinite(depths)
    middle = float(np.median(depths[usable & (depths > 0)])) if (usable & (depths > 0)).any() else 1.0
    held = np.clip(depths / middle, 1 / DEPTH_RANGE, DEPTH_RANGE)
    return np.where(usable, held, 0).astype(np.float32)


def cut_tree(tree: RegionTree, budget: int) -> Groups:
    """Exactly ``budget`` regions over all views, at least one in each; the superpixels themselves if there are fewer.

    The regions of a smaller budget are unions of those of a larger one.

    Raises:
        ValueError: If ``budget`` is below the number of views.
    """
    num_views = len(tree.parents)
    if budget < num_views:
        raise ValueError(f"budget: expected at least {num_views}, one per view, got {budget}")
    keep = np.zeros(len(tree.order), bool)
    keep[tree.order[: max(0, len(tree) - budget)]] = True

    def one_view(view: int) -> tuple[Tensor, int]:
        own = keep[tree.first[view] : tree.first[view + 1]]
        leaves = tree.groups.counts[view]
        of_leaf = torch.from_numpy(cut_labels(tree.parents[view], own, leaves))
        return of_leaf[tree.groups.labels[view].long()], leaves - int(own.sum())

    labels, counts = zip(*parallel_map(one_view, range(num_views)), strict=True)
    return Groups(torch.stack(labels), counts)


def auto_count(tree: RegionTree, options: AllocateOptions | None = None) -> int:
    """The :func:`knee` of a scene, among the counts that need no region larger than ``max_extent``."""
    usable = tree.counts >= tree.least
    return knee(tree.counts[usable], tree.distortions[usable], options)


def knee(counts: np.ndarray, distortions: np.ndarray, options: AllocateOptions | None = None) -> int:
    """The count beyond which more Gaussians are not worth it.

    Predicted quality is q(N) = -10 log10(floor + D(N)) dB. The knee is the largest count from whose surroundings
    (a factor of 1.25) q still grows by ``knee_slope`` dB per relative increase; the least count if there is none.

    Args:
        counts: ``[m]`` in any order, all different.
        distortions: ``[m]`` mean squared error per pixel and channel at each count.
        options: Slope and floor.

    Raises:
        ValueError: If there is no count.
    """
    options = options or AllocateOptions()
    counts, distortions = np.asarray(counts), np.asarray(distortions, dtype=float)
    if len(counts) == 0 or counts.shape != distortions.shape:
        raise ValueError(f"expected as many distortions as counts, got {distortions.shape} for {counts.shape}")
    order = np.argsort(counts)
    scale, error = np.log(counts[order].astype(float)), np.maximum.accumulate(distortions[order][::-1])[::-1]
    quality = -10 * np.log10(options.knee_floor + np.maximum(error, 0))
    before = np.interp(scale - np.log(KNEE_STEP), scale, quality)
    steep = (quality - before) / np.log(KNEE_STEP) >= max(options.knee_slope, 1e-12)
    return int(counts[order][np.flatnonzero(steep)[-1] if steep.any() else 0])


def split_counts(features: FeatureGaussians, members: Members, extra: int, max_children: int = 8) -> np.ndarray:
    """Children of every Feature Gaussian when ``extra`` more Gaussians are spent where they lower distortion most.

    A step that only pays together with the next one is judged by the two together (the convex hull of the
    group's distortion), so a larger ``extra`` never takes a child away. The backing layer stays at one.

    Args:
        features: g Feature Gaussians.
        members: The scene's Gaussians that ``features.members`` points into.
        extra: Gaussians to add, at least 0.
        max_children: Most children of one group.

    Returns:
        ``[g]`` int64, 1 to ``max_children``; their sum is ``g + extra``, or the most that the members give.

    Raises:
        ValueError: If ``extra`` is negative or ``max_children`` below 1.
    """
    if extra < 0:
        raise ValueError(f"extra: expected at least 0, got {extra}")
    if max_children < 1:
        raise ValueError(f"max_children: expected at least 1, got {max_children}")
    if extra == 0:
        return np.ones(len(features), np.int64)
    return 1 + np.bincount(deal_order(features, members, max_children)[:extra], minlength=len(features))


def deal_order(features: FeatureGaussians, members: Members, max_children: int = 8) -> np.ndarray:
    """The Feature Gaussian ``[d]`` that each further Gaussian goes to, where it lowers distortion most first.

    See :func:`split_counts`, which takes the first ones.
    """
    front = np.flatnonzero(~features.backing.numpy())
    if max_children == 1 or len(front) == 0:
        return np.zeros(0, np.int64)
    gains = _hull_gains(_child_errors(features, members, front, max_children))
    # Stable, group by group: of equal gains of one group the first step comes first.
    order = np.argsort(-gains.reshape(-1), kind="stable")
    return front[order[: int(np.isfinite(gains).sum())] // gains.shape[1]]


def _child_errors(features: FeatureGaussians, members: Members, front: np.ndarray, max_children: int) -> np.ndarray:
    """``[f,max_children]`` distortion of 1, 2, ... children; NaN where members do not give that many."""
    starts, ids = features.starts.numpy(), features.members.numpy()
    centres, footprints = features.means.double().numpy(), features.footprints.double().numpy()

    def run(rows: np.ndarray) -> np.ndarray:
        local, own = gather_groups(starts, ids, rows)
        m = members
        return split_errors(
            local, own, m.means, m.sh0, m.opacities, centres[rows], footprints[rows], max_children, PLANE_WEIGHT
        )

    tasks = [front[i : i + GROUPS_PER_TASK] for i in range(0, len(front), GROUPS_PER_TASK)]
    return np.concatenate(parallel_map(run, tasks))


def _hull_gains(errors: np.ndarray) -> np.ndarray:
    """``[f,c-1]`` gain of each further child along the lower convex hull of the errors; -inf where there is none.

    Falls from child to child: the mean gain up to the farthest point of steepest descent, again and again.
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


def trim(importance: Tensor | np.ndarray, count: int) -> Tensor:
    """Indices, rising, of the ``count`` most important Gaussians; of equal ones the first are kept.

    Args:
        importance: ``[n]``, for instance the summed blending weight over all photos.
        count: How many to keep; all if there are fewer.

    Raises:
        ValueError: If ``count`` is negative.
    """
    if count < 0:
        raise ValueError(f"count: expected at least 0, got {count}")
    values = torch.as_tensor(importance).double().nan_to_num(nan=-torch.inf, neginf=-torch.inf)
    return torch.sort(torch.argsort(values, descending=True, stable=True)[:count]).values
