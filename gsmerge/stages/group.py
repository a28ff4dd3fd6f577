"""scene -> groups: how many superpixels each view gets, by density, or cut to a number of Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from gsmerge.budget import exact_count, most_allowed
from gsmerge.errors import UsageError
from gsmerge.options import CompactOptions
from gsmerge.render.photos import scene_pictures
from gsmerge.runtime.estimate import photos_choose
from gsmerge.stages.assign import seen_depths
from gsmerge.stages.choose_merge import MIN_VIEWS
from gsmerge.stages.fit import start_share
from gsmerge.stages.region_tree import RegionTree, auto_count, cut_tree, pixel_depths, region_tree
from gsmerge.stages.segment import count_for, segment
from gsmerge.types import Groups, PixelScene, UnalignedScene


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
    def limit(self) -> int | None:
        """The number that a budget, a size or a preset sets; None where density and K do."""
        return _limit(self.usual, self.most, self.exact)

    @property
    def least(self) -> int:
        """Fewest Gaussians that a scene can be cut to: one for each view."""
        return len(self.pictures)


def scene_canvas(scene: PixelScene | UnalignedScene, options: CompactOptions) -> Canvas:
    """Pictures of the views and limits of the number of Gaussians.

    Raises:
        UsageError: If more superpixels are asked for than there are pixels, or fewer Gaussians than views.
    """
    asked, pixels = asked_per_view(scene, options), scene.pixels_per_view
    if asked > pixels:
        raise UsageError(f"superpixels: expected at most {pixels}, one per pixel, got {asked}")
    usual, most, exact = _counts(scene, options)
    photos, fit = scene.images is not None, options.fit
    share = start_share(fit) if photos else 1.0
    robust = photos and photos_choose(options.robust.robust, fit.fit, fit.effort)
    return Canvas(scene_pictures(scene), robust, share, asked, usual, most, exact)


def usual_count(scene: PixelScene | UnalignedScene, options: CompactOptions) -> int:
    """Gaussians that density and K ask for; of a scene without views, those that density leaves of it."""
    if len(scene) == 0:
        return max(1, int(options.segment.density * scene.num_gaussians)) * options.decode.count
    asked = asked_per_view(scene, options)
    total = asked * scene.num_gaussians // scene.pixels_per_view
    return max(len(scene), total if isinstance(scene, PixelScene) else asked * len(scene)) * options.decode.count


def limit_of(scene: PixelScene | UnalignedScene, options: CompactOptions) -> int | None:
    """The number of Gaussians that a budget, a size or a preset sets; None where density and K do.

    Raises:
        UsageError: If it leaves fewer than one for each view.
    """
    return _limit(*_counts(scene, options))


def _counts(scene: PixelScene | UnalignedScene, options: CompactOptions) -> tuple[int, int, int | None]:
    """What density and K ask for, the most that is allowed, and what a budget or a size asks for."""
    num_input, degree = scene.num_gaussians, scene.gaussians.sh_degree
    most = most_allowed(options.target, num_input, degree)
    if most < min(len(scene), num_input):
        raise UsageError(f"budget: expected at least {len(scene)}, one for each view, got {most}")
    return usual_count(scene, options), most, exact_count(options.target, num_input, degree)


def _limit(usual: int, most: int, exact: int | None) -> int | None:
    return exact if exact is not None else most if usual > most else None


def group_scene(canvas: Canvas, options: CompactOptions) -> Grouping:
    """The same number of superpixels for every view, as density or ``superpixels`` say."""
    each = max(1, int(canvas.each * canvas.share))
    coarse = min(round(_behind(canvas, options) * each), each - 1)
    groups = segment(canvas.pictures, options.segment, each - coarse)
    return Grouping(groups, _coarse(canvas, options, coarse), canvas.robust, canvas.usual, exact=False)


def scene_tree(scene: PixelScene | UnalignedScene, canvas: Canvas, options: CompactOptions, count: int) -> RegionTree:
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
    depths, valid = seen_depths(scene) if isinstance(scene, UnalignedScene) else (pixel_depths(scene), scene.valid)
    return region_tree(canvas.pictures, depths, fine, valid, options.allocate)


def cut_scene(
    scene: PixelScene | UnalignedScene, canvas: Canvas, tree: RegionTree, options: CompactOptions, count: int
) -> Grouping:
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


def asked_per_view(scene: PixelScene | UnalignedScene, options: CompactOptions) -> int:
    """Superpixels of each view. Where there are fewer Gaussians than pixels, ``density`` is a share of those."""
    cameras = scene.cameras
    asked = count_for(options.segment, cameras.height, cameras.width)
    if isinstance(scene, PixelScene) or options.segment.superpixels is not None:
        return asked
    return max(1, min(asked, int(options.segment.density * len(scene.gaussians) / len(cameras))))


def _behind(canvas: Canvas, options: CompactOptions) -> float:
    """Share of the superpixels that the backing layer takes."""
    return options.backing.backing if canvas.robust and len(canvas.pictures) >= MIN_VIEWS else 0.0


def _coarse(canvas: Canvas, options: CompactOptions, count: int) -> Groups | None:
    return segment(canvas.pictures, options.segment, count) if count else None
