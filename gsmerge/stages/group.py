"""scene -> groups: how many superpixels each view gets, evenly or cut from a region tree, and the superpixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from gsmerge.budget import exact_count, max_allowed
from gsmerge.errors import UsageError
from gsmerge.stages.assign import seen_depths
from gsmerge.stages.fit import start_share
from gsmerge.stages.region_tree import RegionTree, auto_count, cut_tree, pixel_depths, region_tree
from gsmerge.stages.segment import MAX_FACTOR, count_for, segment
from gsmerge.types import Scene, Segmentation

if TYPE_CHECKING:
    from gsmerge.options import CompactOptions
    from gsmerge.stages.prepare import PreparedScene


@dataclass(frozen=True, eq=False)
class CountLimits:
    """What is known of the number of Gaussians before any superpixel is chosen.

    Args:
        per_view: Superpixels of each view that the options ask for.
        default: Gaussians that ``superpixels`` and K ask for.
        min_count: Fewest Gaussians that the scene can be cut to: one for each view.
        max_count: Most Gaussians that a budget, a size or a device allows.
        exact: Gaussians that a budget or a size asks for; None without either.
        share: Part of the Gaussians that the fit begins with; it adds the others where the error is.
    """

    per_view: int
    default: int
    min_count: int
    max_count: int
    exact: int | None
    share: float

    @property
    def count(self) -> int | None:
        """The number that a budget, a size or a device sets; None where ``superpixels`` and K do."""
        return limited_count(self.default, self.max_count, self.exact)


def count_limits(scene: Scene, options: CompactOptions) -> CountLimits:
    """Limits of the number of Gaussians of a prepared scene.

    Raises:
        UsageError: If more superpixels are asked for than there are pixels, or fewer Gaussians than views.
    """
    per_view = superpixels_per_view(scene, options)
    default, max_count, exact = _counts(scene, options)
    photos = scene.images is not None
    return CountLimits(
        per_view=per_view,
        default=default,
        min_count=len(scene),
        max_count=max_count,
        exact=exact,
        share=start_share(options.fit) if photos else 1.0,
    )


def default_count(scene: Scene, options: CompactOptions) -> int:
    """Gaussians that ``superpixels`` and K ask for; of a scene without views, a share of its Gaussians."""
    if len(scene) == 0:
        return round(max(1, int(options.segment.share * scene.num_gaussians)) * options.decode.mean_k)
    per_view = superpixels_per_view(scene, options)
    total = per_view * scene.num_gaussians // scene.pixels_per_view
    total = max(len(scene), total if scene.aligned else per_view * len(scene))
    return round(total * options.decode.mean_k)


def largest_count(scene: Scene, options: CompactOptions) -> int:
    """Most Gaussians that ``superpixels`` and K give: more than they ask for where superpixels adapt."""
    default, max_count, _ = _counts(scene, options)
    return min(MAX_FACTOR * default, max_count) if options.segment.adapts else default


def budget_count(scene: Scene, options: CompactOptions) -> int | None:
    """The number of Gaussians that a budget, a size or a device sets; None where ``superpixels`` and K do.

    Raises:
        UsageError: If it leaves fewer than one for each view.
    """
    return limited_count(*_counts(scene, options))


def limited_count(default: int, max_count: int, exact: int | None) -> int | None:
    """The exact count; else the largest allowed one where the default is above it; else None."""
    return exact if exact is not None else max_count if default > max_count else None


def _counts(scene: Scene, options: CompactOptions) -> tuple[int, int, int | None]:
    """Default count, most that is allowed, and the count that a budget or a size asks for."""
    num_input, degree = scene.num_gaussians, scene.gaussians.sh_degree
    max_count = max_allowed(options.budget, num_input, degree)
    if max_count < min(len(scene), num_input):
        raise UsageError(f"budget: expected at least {len(scene)}, one for each view, got {max_count}")
    return default_count(scene, options), max_count, exact_count(options.budget, num_input, degree)


def superpixels_per_view(scene: Scene, options: CompactOptions) -> int:
    """Superpixels of each view. Where there are fewer Gaussians than pixels, a share is taken of the Gaussians."""
    cameras = scene.cameras
    per_view = count_for(options.segment, cameras.height, cameras.width)
    if scene.aligned or options.segment.per_view is not None:
        return per_view
    return max(1, min(per_view, int(options.segment.share * len(scene.gaussians) / len(cameras))))


def segment_scene(prepared: PreparedScene, count: int | None) -> Segmentation:
    """Superpixels of every view: as many as the options say, or cut to become exactly ``count`` Gaussians.

    A count is cut from the region tree, in which a plain wall ends up with few superpixels and a fern with many; from
    a finer tree where the scene's own does not reach it. Superpixels that adapt change the number of Gaussians as
    they change their own; where that is above what a budget allows, it is cut to the largest one allowed.
    """
    limits, options, pictures = prepared.limits, prepared.options, prepared.pictures
    views = len(pictures)
    if count is None:
        each = max(1, int(limits.per_view * limits.share))
        if not options.segment.adapts:
            return Segmentation(segment(pictures, options.segment, each), limits.default, exact=False)
        # to the number in the end, of which the fit begins with a share
        groups = segment(pictures, options.segment, limits.per_view, adapt=each / limits.per_view)
        count = round(limits.default * len(groups) / (each * views))
        if count <= limits.max_count:
            return Segmentation(groups, count, exact=False)
        count = limits.max_count
    tree = prepared.tree
    first = max(views, int(count * limits.share))
    if tree is None or first > len(tree):
        tree = scene_tree(prepared, count)
    return Segmentation(cut_tree(tree, first), count, exact=True)


def with_tree(prepared: PreparedScene) -> PreparedScene:
    """The prepared scene with the region tree for any count up to the default or the exact one."""
    return replace(prepared, tree=scene_tree(prepared, prepared.limits.exact or prepared.limits.default))


def scene_tree(prepared: PreparedScene, count: int) -> RegionTree:
    """All ways to cut the scene into fewer superpixels, those of all views merged where that costs least.

    Args:
        prepared: The scene.
        count: Most Gaussians that it will be cut to.
    """
    scene, options, pictures = prepared.scene, prepared.options, prepared.pictures
    leaves = min(max(prepared.limits.per_view, -(-count // len(scene))), scene.pixels_per_view)
    fine = segment(pictures, options.segment, leaves)
    depths, valid = seen_depths(scene) if not scene.aligned else (pixel_depths(scene), scene.valid)
    return region_tree(pictures, depths, fine, valid, options.allocate)


def knee_count(prepared: PreparedScene) -> int:
    """The knee of the scene's own curve of distortion, at most what is allowed."""
    limits = prepared.limits
    tree = prepared.tree or scene_tree(prepared, limits.default)
    return max(limits.min_count, min(auto_count(tree, prepared.options.allocate), limits.max_count))
