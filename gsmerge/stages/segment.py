"""Scene -> groups: the superpixels of every view, evenly many or cut from a region tree."""

from __future__ import annotations

from dataclasses import dataclass

from gsmerge.budget import exact_count, max_allowed
from gsmerge.errors import UsageError
from gsmerge.facts.views import camera_kinds
from gsmerge.raster.photos import scene_pictures
from gsmerge.raster.seen import seen_depths
from gsmerge.runtime.record import stage
from gsmerge.settings.budget import BudgetOptions
from gsmerge.settings.stages import DecodeOptions, SegmentOptions
from gsmerge.stages.region_tree import RegionTree, auto_count, cut_tree, pixel_depths, region_tree
from gsmerge.stages.superpixels import MAX_FACTOR, count_for, segment
from gsmerge.types import Scene, Segmentation


@dataclass(frozen=True, eq=False)
class SuperpixelPlan:
    """Method and numbers for cutting a scene into superpixels."""

    options: SegmentOptions  # Method and number
    limits: CountLimits  # Limits of the number of Gaussians
    start_share: float  # Share of the Gaussians to start with; a fit adds the others
    tree: RegionTree | None  # All coarser superpixels, where a count is asked for


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
    """Build the tree of all coarser superpixels of a scene, fine enough for ``count`` Gaussians."""
    pictures = scene_pictures(scene)
    leaves = min(max(limits.per_view, -(-count // len(scene))), scene.pixels_per_view)
    depths, valid = (pixel_depths(scene), scene.valid) if scene.aligned else seen_depths(scene)
    return region_tree(pictures, depths, segment(pictures, options, leaves), valid)


def knee_count(scene: Scene, plan: SuperpixelPlan) -> int:
    """Find the knee of the scene's own curve of distortion, at most what is allowed."""
    limits = plan.limits
    tree = plan.tree or scene_tree(scene, plan.options, limits, limits.default)
    return max(limits.min_count, min(auto_count(tree), limits.max_count))


@dataclass(frozen=True)
class CountLimits:
    """Limits that the options set for the number of Gaussians."""

    per_view: int  # Superpixels of each view that the options ask for
    default: int  # Gaussians that `superpixels` and K ask for
    min_count: int  # Fewest Gaussians that the scene can be cut to: one for each view
    max_count: int  # Most Gaussians that a budget, a size or a device allows
    exact: int | None  # Gaussians that a budget or a size asks for; None without either
    num_pixels: int  # Of all views

    @property
    def count(self) -> int | None:
        """Number that a budget, a size or a device sets; None where ``superpixels`` and K decide."""
        if self.exact is not None:
            return self.exact
        return self.max_count if self.default > self.max_count else None

    @property
    def share(self) -> float:
        """Gaussians for each pixel."""
        return (self.count or self.default) / max(1, self.num_pixels)


@dataclass(frozen=True)
class SceneSize:
    """Numbers of a scene, read or not, that a plan is made of."""

    num_gaussians: int  # without rows that stand in for missing ones
    num_views: int
    height: int  # pixels
    width: int
    aligned: bool  # whether each Gaussian belongs to a pixel
    photos: bool  # whether there are photos to fit to
    num_cameras: int = 2  # views at different places; 1: one camera took all
    sh_degree: int = 0

    @property
    def pixels_per_view(self) -> int:
        """Pixels of each view."""
        return self.height * self.width


def measure_size(scene: Scene, *, photos: bool | None = None) -> SceneSize:
    """Return the numbers of a scene; ``photos``: whether there are any to fit to, None: as the scene has them."""
    cameras = scene.cameras
    return SceneSize(
        scene.num_gaussians, len(scene), cameras.height, cameras.width, scene.aligned,
        photos=scene.images is not None if photos is None else photos,
        num_cameras=1 + int(camera_kinds(cameras).max()) if len(scene) else 0,
        sh_degree=scene.gaussians.sh_degree,
    )  # fmt: skip


def count_limits(
    scene: SceneSize,
    segment: SegmentOptions,
    decode: DecodeOptions,
    budget: BudgetOptions,
    *,
    num_input: int | None = None,
    num_reserved: int = 0,
) -> CountLimits:
    """Compute the limits of the number of Gaussians.

    ``num_input``: Gaussians that shares of a budget refer to; None: the scene's. ``num_reserved``:
    Gaussians of the result that are settled already, such as those that no view sees. Raises
    UsageError if more superpixels are asked for than there are pixels, or fewer Gaussians than
    views.
    """
    count, views = scene.num_gaussians, scene.num_views
    exact = exact_count(budget, count if num_input is None else num_input, scene.sh_degree)
    if exact is not None:
        exact = min(max(1, exact - num_reserved), count)
    max_count = min(max_allowed(budget, count, scene.sh_degree), count if exact is None else exact)
    if max_count < min(views, count):
        raise UsageError(f"budget: expected at least {views}, one for each view, got {max_count}")
    return CountLimits(
        per_view=superpixels_per_view(scene, segment) if views else 0,
        default=default_count(scene, segment, decode),
        min_count=views,
        max_count=max_count,
        exact=exact,
        num_pixels=views * scene.pixels_per_view,
    )


def superpixels_per_view(scene: SceneSize, segment: SegmentOptions) -> int:
    """Return the superpixels of each view; where Gaussians are fewer than pixels, a share is taken of the Gaussians."""
    per_view = count_for(segment, scene.height, scene.width)
    if scene.aligned or segment.per_view is not None:
        return per_view
    return max(1, min(per_view, int(segment.share * scene.num_gaussians / scene.num_views)))


def default_count(scene: SceneSize, segment: SegmentOptions, decode: DecodeOptions) -> int:
    """Return the Gaussians that ``superpixels`` and K ask for; of a scene without views, a share of its Gaussians."""
    count, views = scene.num_gaussians, scene.num_views
    if views == 0:
        return round(max(1, int(segment.share * count)) * decode.mean_k)
    per_view = superpixels_per_view(scene, segment)
    total = per_view * count // scene.pixels_per_view if scene.aligned else per_view * views
    return round(max(views, total) * decode.mean_k)


def largest_count(limits: CountLimits, segment: SegmentOptions) -> int:
    """Return the most Gaussians that a run can give: superpixels that adapt may become more than are asked for."""
    if limits.count is not None:
        return limits.count
    return min(MAX_FACTOR * limits.default, limits.max_count) if segment.adapts else limits.default
