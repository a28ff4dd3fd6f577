"""Scene -> groups: cut every view into superpixels, either equally many in each, or as many as a region tree gives it.

The tree merges neighbouring superpixels of all views. Merges that add the least distortion come first. A cut through
the tree has few superpixels where merges lose little, and many elsewhere, so every Gaussian lowers the distortion about
equally. The distortion is measured in the image, and is the squared error of colours plus the squared relative error of
depths from a plane. As depths are compared with a plane, a flat wall costs nothing from any angle, and as errors of
depth are relative, far things count as much as near things.
"""

from __future__ import annotations

import numpy as np

from gsmerge.frozen import dataclass
from gsmerge.method.geometry.transforms import camera_depths
from gsmerge.method.kernels.elementary import log, log10
from gsmerge.method.kernels.superpixels.merge_tree import (
    OVERSIZE,
    PLANE_ERROR,
    TREE_COLUMNS,
    cut_labels,
    merge_order,
    region_sums,
)
from gsmerge.method.kernels.superpixels.regions import pad_labels
from gsmerge.method.kernels.superpixels.ward import adjacent_pairs
from gsmerge.method.stages.limits import CountLimits
from gsmerge.method.stages.superpixels import segment
from gsmerge.runtime.record import stage
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.stages import SegmentOptions
from gsmerge.types import Groups, PicturedScene, Scene, Segmentation

DEPTH_WEIGHT = 1.0  # weight of squared relative depth errors, relative to squared colour errors (sRGB in [0, 1])
# Largest side of a region, as a share of the image's longer side. Gaussians of larger regions would show the error of
# the rasterizer's affine approximation. Regions are larger only if the budget is too small
MAX_EXTENT = 1 / 8
# At the knee, the predicted quality still rises by REGION_KNEE_SLOPE dB per relative increase of the number of
# Gaussians
REGION_KNEE_SLOPE = 1.0
KNEE_FLOOR = 3e-4  # squared error per pixel and channel that no number of Gaussians removes, such as noise


@dataclass(frozen=True, eq=False)
class SuperpixelChoices:
    """How a scene is cut into superpixels."""

    options: SegmentOptions  # Method, and number of superpixels
    start_share: float = 1.0  # Share of the Gaussians with which the fit starts, before it adds the rest
    shared: SharedTree | None = None  # Region tree for all counts that a run tries; None: each count builds a tree


@dataclass(eq=False)
class SharedTree:
    """A region tree, which a run cuts for each count that it tries."""

    tree: RegionTree | None = None

    def get(self, scene: PicturedScene, options: SegmentOptions, limits: CountLimits) -> RegionTree:
        """Return the tree of a scene, which the first call builds with enough superpixels for the requested count."""
        if self.tree is None:
            self.tree = scene_tree(scene, options, limits, limits.exact or limits.default)
        return self.tree


@stage("segment")
def segment_scene(
    scene: PicturedScene, choices: SuperpixelChoices, limits: CountLimits, count: int | None
) -> Segmentation:
    """Cut every view into superpixels, for exactly ``count`` Gaussians, or for the default number if None.

    An exact count is cut from the region tree, which gives a plain wall few superpixels and a fern many. Scenes whose
    pixels differ in importance are always cut from the tree. If the shared tree is too coarse, a finer tree is built.
    """
    options = choices.options
    num_views = len(scene)
    if count is None and scene.protected is not None:
        count = limits.default
    if count is None:
        start_per_view = max(1, int(limits.per_view * choices.start_share))
        return Segmentation(segment(scene.images, options, start_per_view), limits.default, exact=False)
    tree = choices.shared.get(scene, options, limits) if choices.shared else None
    start_count = max(num_views, int(count * choices.start_share))
    if tree is None or start_count > len(tree):
        tree = scene_tree(scene, options, limits, count)
    return Segmentation(cut_tree(tree, start_count), count, exact=True)


@stage("segment")
def scene_tree(scene: PicturedScene, options: SegmentOptions, limits: CountLimits, count: int) -> RegionTree:
    """Build the region tree of a scene from enough superpixels for ``count`` Gaussians.

    The squared colour error of a pixel is multiplied by its importance if that is above 1. For this, colours are
    multiplied by the square root of the importance.
    """
    images = scene.images
    per_view = max(limits.per_view, -(-count // len(scene)))
    if scene.importance is not None and scene.protected is not None:
        images = images * np.sqrt(np.maximum(scene.importance, 1))[..., None]
        per_view = int(per_view * scene.importance.max())  # important pixels need more superpixels
    groups = segment(scene.images, options, min(per_view, scene.pixels_per_view))
    return region_tree(images, front_depths(scene), groups, scene.get_pixels().shown)


def knee_count(scene: PicturedScene, choices: SuperpixelChoices, limits: CountLimits) -> int:
    """Return the number of Gaussians at the knee of the scene's distortion curve, clipped to the limits."""
    shared = choices.shared or SharedTree()
    tree = shared.get(scene, choices.options, limits)
    usable = tree.counts >= tree.min_regions  # counts without regions larger than MAX_EXTENT
    return max(limits.min_count, min(knee(tree.counts[usable], tree.distortions[usable]), limits.max_count))


@dataclass(frozen=True, eq=False)
class RegionTree:
    """Merges of neighbouring regions, from the superpixels of all views to a single region in each view."""

    groups: Groups  # The superpixels before all merges, which are the leaves of the tree
    parents: tuple[np.ndarray, ...]  # For each view [2·leaves-1] int32, the parent of each region, or -1
    order: np.ndarray  # [m] int64 numbers of all merges, the cheapest first; merges of view v start at `offsets[v]`
    offsets: np.ndarray  # [v+1] int64, number of merges in all views before each
    distortions: np.ndarray  # [m+1] float64 mean squared error after 0 to m merges
    min_regions: int  # Least number of regions of which none is larger than `MAX_EXTENT`

    def __len__(self) -> int:
        """Return the number of superpixels before all merges."""
        return len(self.groups)

    @property
    def counts(self) -> np.ndarray:
        """Numbers of regions ``[m+1]`` after 0 to m merges."""
        return len(self) - np.arange(len(self.distortions))


def front_depths(scene: Scene) -> np.ndarray:
    """Return the depth ``[v,h,w]`` float32, in world units, of the front Gaussian of every pixel."""
    cameras, means, fronts = scene.cameras, scene.gaussians.means, scene.get_pixels().fronts

    def view_depths(view: int) -> np.ndarray:
        """Return the depths ``[h,w]`` of one view."""
        depths = camera_depths(means[fronts[view]], cameras.viewmats[view].astype(means.dtype))
        return depths.astype(np.float32)

    return np.stack(parallel_map(view_depths, range(len(scene))))


def region_tree(images: np.ndarray, depths: np.ndarray, groups: Groups, valid: np.ndarray) -> RegionTree:
    """Merge neighbouring superpixels in order of the distortion that this adds, until each view is a single region.

    ``images [v,h,w,3]`` are sRGB in [0, 1]. ``depths [v,h,w]`` of 0 or less count as very near. ``groups`` are
    4-connected and not empty. Pixels that are not ``valid [v,h,w]`` do not count, and superpixels without valid pixels
    are merged first. Raises ValueError if the arguments do not fit together.
    """
    shape = list(groups.labels.shape)
    for name, array, expected in (("images", images, [*shape, 3]), ("depths", depths, shape), ("valid", valid, shape)):
        if list(array.shape) != expected:
            raise ValueError(f"{name}: expected shape {expected}, got {list(array.shape)}")
    for view, count in enumerate(groups.counts):
        sizes = np.bincount(groups.labels[view].reshape(-1), minlength=count)
        if len(sizes) > count or int(sizes.min()) < 1:
            raise ValueError(f"groups: expected {count} superpixels with pixels in view {view}")
    max_extent = max(1.0, MAX_EXTENT * max(images.shape[1:3]))

    def merge_view(view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, int]:
        """Return three arrays of :func:`merge_order`, the error before all merges, and the number of usable pixels."""
        # Depths in units of their median, and 0 for pixels that are not valid or have no finite depth
        is_usable = valid[view] & np.isfinite(depths[view])
        positive = is_usable & (depths[view] > 0)
        median = float(np.median(depths[view][positive])) if positive.any() else 1.0
        depth_range = 1e3  # largest factor by which a depth may be above or below the median
        clipped = np.clip(depths[view] / median, 1 / depth_range, depth_range)
        usable = np.ascontiguousarray(np.where(is_usable, clipped, 0), np.float32)
        labels = pad_labels(groups.labels[view])
        count = groups.counts[view]
        pixels = np.ascontiguousarray(images[view], np.float32)
        rows = np.empty((2 * count, TREE_COLUMNS))
        error = region_sums(labels, pixels, usable, count, rows) + DEPTH_WEIGHT * float(rows[:count, PLANE_ERROR].sum())
        pairs = adjacent_pairs(labels)
        # Weight of squared distances in pixels, relative to squared differences of colours. If distances had a smaller
        # weight, regions would become long and winding, so that no Gaussian fits them
        region_compactness = 1e-5
        return *merge_order(pairs, rows, DEPTH_WEIGHT, region_compactness, max_extent), error, int((usable > 0).sum())

    merged_views = parallel_map(merge_view, range(len(images)))
    parents, view_heights, growths, errors, num_pixels = zip(*merged_views, strict=True)
    offsets = np.concatenate([[0], np.cumsum([len(h) for h in view_heights])])
    heights = np.concatenate(view_heights)
    # A merge is at least as high as the merges that made its two regions, and comes after them. A stable sort keeps
    # this order
    order = np.argsort(heights, kind="stable")
    added = np.concatenate([[sum(errors)], np.concatenate(growths)[order]])
    distortions = np.cumsum(added) / (3 * max(sum(num_pixels), 1))
    min_regions = len(groups) - int(np.count_nonzero(heights < OVERSIZE))
    return RegionTree(
        groups, parents=parents, order=order, offsets=offsets, distortions=distortions, min_regions=min_regions
    )


def cut_tree(tree: RegionTree, budget: int) -> Groups:
    """Cut the tree into exactly ``budget`` regions in all views together, at least one in each view.

    If ``budget`` is above the number of superpixels, all superpixels are returned. The regions of a smaller budget are
    unions of the regions of a larger budget. Raises ValueError if ``budget`` is below the number of views.
    """
    num_views = len(tree.parents)
    if budget < num_views:
        raise ValueError(f"budget: expected at least {num_views}, one per view, got {budget}")
    is_merged = np.zeros(len(tree.order), bool)
    is_merged[tree.order[: max(0, len(tree) - budget)]] = True

    def cut_view(view: int) -> tuple[np.ndarray, int]:
        """Return the labels of the pixels of a view, and the number of its regions."""
        is_view_merged = is_merged[tree.offsets[view] : tree.offsets[view + 1]]
        leaves = tree.groups.counts[view]
        leaf_labels = cut_labels(tree.parents[view], is_view_merged, leaves)
        return leaf_labels[tree.groups.labels[view]], leaves - int(is_view_merged.sum())

    labels, counts = zip(*parallel_map(cut_view, range(num_views)), strict=True)
    return Groups(np.stack(labels), counts)


def knee(counts: np.ndarray, distortions: np.ndarray) -> int:
    """Return the count beyond which more Gaussians add little quality.

    The predicted quality of N Gaussians is q(N) = -10 log10(``KNEE_FLOOR`` + D(N)) dB, where D is the distortion. The
    slope of q at N is measured between N / 1.25 and N, in dB per relative increase of N. The knee is the largest N with
    a slope of at least ``REGION_KNEE_SLOPE``, or the least N if there is none. ``counts [m]`` are all different, and
    ``distortions [m]`` are mean squared errors per pixel and channel.
    """
    counts = np.asarray(counts)
    distortions = np.asarray(distortions, dtype=float)
    if len(counts) == 0 or counts.shape != distortions.shape:
        raise ValueError(f"expected as many distortions as counts, got {distortions.shape} for {counts.shape}")
    order = np.argsort(counts)
    log_counts = log(counts[order].astype(float))
    error = np.maximum.accumulate(distortions[order][::-1])[::-1]
    quality = -10 * log10(KNEE_FLOOR + np.maximum(error, 0))
    knee_step = 1.25  # the slope of the curve is measured over this factor of the count
    before = np.interp(log_counts - log(knee_step), log_counts, quality)
    steep = (quality - before) / log(knee_step) >= REGION_KNEE_SLOPE
    return int(counts[order][np.flatnonzero(steep)[-1] if steep.any() else 0])
