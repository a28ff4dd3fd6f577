"""scene -> groups: the superpixels of every view, evenly many or cut from a region tree."""

from __future__ import annotations

from dataclasses import dataclass

from gsmerge.render.photos import scene_pictures
from gsmerge.runtime.record import stage
from gsmerge.stages.assign import seen_depths
from gsmerge.stages.counts import CountLimits
from gsmerge.stages.region_tree import RegionTree, auto_count, cut_tree, pixel_depths, region_tree
from gsmerge.stages.superpixels import SegmentOptions, segment
from gsmerge.types import Scene, Segmentation


@dataclass(frozen=True, eq=False)
class SuperpixelPlan:
    """How a scene is cut into superpixels.

    Args:
        options: Method and number.
        limits: Of the number of Gaussians.
        start_share: Share of the Gaussians that the superpixels are cut for; a fit adds the others.
        tree: All ways to cut the scene into fewer superpixels, where a count is asked for; None elsewhere.
    """

    options: SegmentOptions
    limits: CountLimits
    start_share: float
    tree: RegionTree | None


@stage("segment")
def segment_scene(scene: Scene, plan: SuperpixelPlan, count: int | None) -> Segmentation:
    """Cut every view into as many superpixels as the plan says, or into those that become exactly ``count`` Gaussians.

    A count is cut from the region tree, in which a plain wall ends up with few superpixels and a fern with many; from
    a finer tree where the scene's own does not reach it. Superpixels that adapt change the number of Gaussians as
    they change their own; where that is above what a budget allows, it is cut to the largest one allowed.
    """
    limits, options, views = plan.limits, plan.options, len(scene)
    if count is None:
        pictures, each = scene_pictures(scene), max(1, int(limits.per_view * plan.start_share))
        if not options.adapts:
            return Segmentation(segment(pictures, options, each), limits.default, exact=False)
        # to the number in the end, of which the fit begins with a share
        groups = segment(pictures, options, limits.per_view, adapt=each / limits.per_view)
        count = round(limits.default * len(groups) / (each * views))
        if count <= limits.max_count:
            return Segmentation(groups, count, exact=False)
        count = limits.max_count
    tree = plan.tree
    first = max(views, int(count * plan.start_share))
    if tree is None or first > len(tree):
        tree = scene_tree(scene, options, limits, count)
    return Segmentation(cut_tree(tree, first), count, exact=True)


@stage("segment")
def scene_tree(scene: Scene, options: SegmentOptions, limits: CountLimits, count: int) -> RegionTree:
    """Find all ways to cut a scene into fewer superpixels, those of all views merged where that costs least.

    Args:
        scene: The canonical scene.
        options: How the finest superpixels are cut.
        limits: Of the number of Gaussians.
        count: Most Gaussians that it will be cut to.
    """
    pictures = scene_pictures(scene)
    leaves = min(max(limits.per_view, -(-count // len(scene))), scene.pixels_per_view)
    depths, valid = (pixel_depths(scene), scene.valid) if scene.aligned else seen_depths(scene)
    return region_tree(pictures, depths, segment(pictures, options, leaves), valid)


def knee_count(scene: Scene, plan: SuperpixelPlan) -> int:
    """Find the knee of the scene's own curve of distortion, at most what is allowed."""
    limits = plan.limits
    tree = plan.tree or scene_tree(scene, plan.options, limits, limits.default)
    return max(limits.min_count, min(auto_count(tree), limits.max_count))
