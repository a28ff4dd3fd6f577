"""scene -> groups: how many superpixels each view gets, by density, or cut to a number of Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from gsmerge.allocate import RegionTree, auto_count, cut_tree, pixel_depths, region_tree
from gsmerge.errors import UsageError
from gsmerge.fit import start_share
from gsmerge.options import CompactOptions
from gsmerge.photos import scene_pictures
from gsmerge.robust import MIN_VIEWS
from gsmerge.segment import count_for, segment
from gsmerge.targets import exact_count, most_allowed
from gsmerge.types import Groups, PixelScene


@dataclass(frozen=True)
class Grouping:
    """The superpixels of a scene and what they are to become.

    Args:
        groups: Superpixels of every view.
        coarse: Coarse ones for the backing layer; None: no such layer.
        robust: Whether the merge is chosen by the photos.
        wanted: Gaussians in the end; never more.
        exact: Whether that number was asked for as such, and is to be met.
    """

    groups: Groups
    coarse: Groups | None
    robust: bool
    wanted: int
    exact: bool


@dataclass(frozen=True, eq=False)
class Canvas:
    """The views of a scene and what is known of the number of Gaussians before any superpixel is chosen.

    Args:
        pictures: ``[v,h,w,3]`` what superpixels are cut from.
        robust: Whether the merge is chosen by the photos.
        share: Part of the Gaussians that the stages before the fit leave for it to begin with.
        each: Superpixels of each view that the options ask for.
        usual: Gaussians that density and K ask for.
        most: Gaussians that budget, size and preset allow.
        exact: Gaussians that a budget or a size asks for; None without either.
    """

    pictures: Tensor
    robust: bool
    share: float
    each: int
    usual: int
    most: int
    exact: int | None

    @property
    def least(self) -> int:
        """Fewest Gaussians that a scene can be cut to: one for each view."""
        return len(self.pictures)


def scene_canvas(scene: PixelScene, options: CompactOptions) -> Canvas:
    """Pictures of the views and limits of the number of Gaussians.

    Raises:
        UsageError: If more superpixels are asked for than there are pixels, or fewer Gaussians than views.
    """
    pixels, degree = scene.pixels_per_view, scene.gaussians.sh_degree
    asked = count_for(options.segment, scene.cameras.height, scene.cameras.width)
    if asked > pixels:
        raise UsageError(f"superpixels: expected at most {pixels}, one per pixel, got {asked}")
    num_input = scene.num_gaussians
    most = most_allowed(options.target, num_input, degree)
    if most < len(scene):
        raise UsageError(f"budget: expected at least {len(scene)}, one for each view, got {most}")
    share = start_share(options.fit) if scene.images is not None else 1.0
    usual = max(len(scene), asked * num_input // pixels) * options.decode.count
    exact = exact_count(options.target, num_input, degree)
    return Canvas(scene_pictures(scene), uses_robust(scene, options), share, asked, usual, most, exact)


def group_scene(canvas: Canvas, options: CompactOptions) -> Grouping:
    """The same number of superpixels for every view, as density or ``superpixels`` say."""
    each = max(1, int(canvas.each * canvas.share))
    coarse = min(round(_behind(canvas, options) * each), each - 1)
    groups = segment(canvas.pictures, options.segment, each - coarse)
    return Grouping(groups, _coarse(canvas, options, coarse), canvas.robust, canvas.usual, exact=False)


def scene_tree(scene: PixelScene, canvas: Canvas, options: CompactOptions, count: int) -> RegionTree:
    """All ways to cut the scene into fewer superpixels, those of all views merged where that costs least.

    A wall ends up with few, a fern with many.

    Args:
        scene: The canonical scene.
        canvas: Its pictures.
        options: All settings.
        count: Most Gaussians that it will be cut to.
    """
    leaves = min(max(canvas.each, -(-count // len(scene))), scene.pixels_per_view)
    fine = segment(canvas.pictures, options.segment, leaves)
    return region_tree(canvas.pictures, pixel_depths(scene), fine, scene.valid, options.allocate)


def cut_scene(scene: PixelScene, canvas: Canvas, tree: RegionTree, options: CompactOptions, count: int) -> Grouping:
    """The superpixels that become exactly ``count`` Gaussians; from a finer tree where this one does not reach."""
    views = len(canvas.pictures)
    begun = max(views, int(count * canvas.share))
    if begun > len(tree):
        tree = scene_tree(scene, canvas, options, count)
    coarse = int(_behind(canvas, options) * begun / views)
    groups = cut_tree(tree, max(views, begun - coarse * views))
    return Grouping(groups, _coarse(canvas, options, coarse), canvas.robust, count, exact=True)


def knee_count(tree: RegionTree, canvas: Canvas, options: CompactOptions) -> int:
    """The knee of the scene's own curve of distortion, at most what is allowed."""
    return max(canvas.least, min(auto_count(tree, options.allocate), canvas.most))


def uses_robust(scene: PixelScene, options: CompactOptions) -> bool:
    """Whether the photos choose the merge: as asked, otherwise unless a full fit follows."""
    asked = options.robust.robust
    return scene.images is not None and (options.fit.fit != "full" if asked is None else asked)


def _behind(canvas: Canvas, options: CompactOptions) -> float:
    """Share of the superpixels that the backing layer takes."""
    return options.backing.backing if canvas.robust and len(canvas.pictures) >= MIN_VIEWS else 0.0


def _coarse(canvas: Canvas, options: CompactOptions, count: int) -> Groups | None:
    return segment(canvas.pictures, options.segment, count) if count else None
