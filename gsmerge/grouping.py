"""scene -> groups: how many superpixels each view gets, by density, budget or the scene's own knee."""

from __future__ import annotations

from dataclasses import dataclass

from gsmerge.allocate import auto_count, count_for_bytes, cut_tree, parse_budget, parse_bytes, pixel_depths, region_tree
from gsmerge.contribution import seen_depths
from gsmerge.errors import UsageError
from gsmerge.fit import start_share
from gsmerge.options import CompactOptions
from gsmerge.photos import scene_pictures
from gsmerge.robust import MIN_VIEWS
from gsmerge.segment import count_for, segment
from gsmerge.types import Groups, LooseScene, PixelScene


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


def group_scene(scene: PixelScene | LooseScene, options: CompactOptions) -> Grouping:
    """Superpixels of every view.

    Without a budget every view gets the same number. With one, or with ``k="auto"``, the superpixels of all views are
    merged in the order of the distortion that it adds until the number is met: a wall ends up with few, a fern
    with many.

    Args:
        scene: The canonical scene.
        options: All settings.

    Raises:
        UsageError: If more superpixels are asked for than there are pixels, or fewer Gaussians than views.
    """
    views, pixels = len(scene), scene.pixels_per_view
    pictures = scene_pictures(scene)
    robust = uses_robust(scene, options)
    behind = options.backing.backing if robust and views >= MIN_VIEWS else 0.0
    share = start_share(options.fit) if scene.images is not None else 1.0
    asked = asked_per_view(scene, options)
    if asked > pixels:
        raise UsageError(f"superpixels: expected at most {pixels}, one per pixel, got {asked}")
    wanted, auto = target_count(scene, options), options.decode.k == "auto"
    if wanted is None and not auto:
        count = max(1, int(asked * share))
        coarse = min(round(behind * count), count - 1)
        groups = segment(pictures, options.segment, count - coarse)
        total = asked * views * options.decode.count
    else:
        leaves = min(max(asked, -(-(wanted or 0) // views)), pixels)
        fine = segment(pictures, options.segment, leaves)
        if isinstance(scene, LooseScene):
            depths, valid = seen_depths(scene)
        else:
            depths, valid = pixel_depths(scene), scene.valid
        tree = region_tree(pictures, depths, fine, valid, options.allocate)
        knee = auto_count(tree, options.allocate) if auto else len(tree)
        total = min(knee, wanted) if wanted is not None and auto else wanted if wanted is not None else knee
        if total < views:
            raise UsageError(f"budget: expected at least {views}, one for each view, got {total}")
        begun = max(views, int(total * share))
        coarse = int(behind * begun / views)
        groups = cut_tree(tree, max(views, begun - coarse * views))
    coarse_groups = segment(pictures, options.segment, coarse) if coarse else None
    return Grouping(groups, coarse_groups, robust, total, exact=wanted is not None or auto)


def asked_per_view(scene: PixelScene | LooseScene, options: CompactOptions) -> int:
    """Superpixels of each view. Where there are fewer Gaussians than pixels, ``density`` is a share of those."""
    cameras = scene.cameras
    asked = count_for(options.segment, cameras.height, cameras.width)
    if isinstance(scene, PixelScene) or options.segment.superpixels is not None:
        return asked
    return max(1, min(asked, int(options.segment.density * len(scene.gaussians) / len(cameras))))


def uses_robust(scene: PixelScene | LooseScene, options: CompactOptions) -> bool:
    """Whether the photos choose the merge: as asked, otherwise unless a full fit follows."""
    asked = options.robust.robust
    return scene.images is not None and (options.fit.fit != "full" if asked is None else asked)


def target_count(scene: PixelScene | LooseScene, options: CompactOptions) -> int | None:
    """The number of Gaussians that a budget or a file size asks for, the smaller of the two; None without either."""
    num_input, wanted = len(scene.gaussians), []
    if options.budget is not None:
        wanted.append(parse_budget(options.budget, num_input))
    if options.max_bytes is not None:
        wanted.append(count_for_bytes(parse_bytes(options.max_bytes), scene.gaussians.sh_degree))
    return min(*wanted, num_input) if wanted else None
