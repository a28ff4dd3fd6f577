"""scene -> prepared scene: in the frame that all arithmetic runs in, with everything that the next stages need.

The canonical frame has its origin at the scene's middle and the median depth as its unit, so that float32 keeps its
precision far from the world's origin and thresholds (near plane, floors) mean the same at every scale. The unit is a
power of two: scaling there and back changes no bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from gsmerge.budget import exact_count
from gsmerge.errors import UsageError
from gsmerge.geometry import lower_median, project
from gsmerge.moments import Members, scene_members
from gsmerge.render.photos import scene_pictures
from gsmerge.runtime.record import note, stage
from gsmerge.runtime.threads import parallel_map
from gsmerge.stages.agreement import choose_superpixels
from gsmerge.stages.align_views import align_views
from gsmerge.stages.assign import ContributionOptions, split_unseen
from gsmerge.stages.check_photos import leave_out_photos
from gsmerge.stages.group import CountLimits, count_limits, with_tree
from gsmerge.stages.place_cameras import add_pictures, add_views
from gsmerge.stages.region_tree import RegionTree
from gsmerge.types import Cameras, Gaussians, Scene
from gsmerge.views import distinct_views, report_views, scored_views, subset

if TYPE_CHECKING:
    from gsmerge.networks.apply import NetworkContext
    from gsmerge.networks.checkpoint import Checkpoint
    from gsmerge.options import CompactOptions

SAMPLES = 65536  # Gaussians that the frame is measured on
ROWS = 65536  # Gaussians per task
MAX_VIEWS = 32  # of an unaligned scene, that the unit is taken from


@dataclass(frozen=True)
class Frame:
    """x_canonical = (x_world - origin) / unit.

    Args:
        origin: ``[3]`` float64, world units.
        unit: Length of the canonical unit in world units, a power of two.
    """

    origin: np.ndarray
    unit: float

    def enter(self, gaussians: Gaussians) -> Gaussians:
        """World to canonical; means in float32."""
        means, scales = np.empty(gaussians.means.shape, np.float32), np.empty_like(gaussians.scales)

        def fill(first: int) -> None:
            rows = slice(first, first + ROWS)
            means[rows] = (gaussians.means[rows] - self.origin) / self.unit
            np.divide(gaussians.scales[rows], self.unit, out=scales[rows])

        parallel_map(fill, range(0, len(gaussians), ROWS))
        return replace(gaussians, means=means, scales=scales)

    def leave(self, gaussians: Gaussians) -> Gaussians:
        """Canonical to world; means in float64."""
        means = gaussians.means.astype(np.float64) * self.unit + self.origin
        return replace(gaussians, means=means, scales=gaussians.scales * self.unit)

    def leave_cameras(self, cameras: Cameras) -> Cameras:
        """Canonical to world."""
        viewmats = cameras.viewmats.astype(np.float64)
        viewmats[:, :3, 3] = self.unit * viewmats[:, :3, 3] - viewmats[:, :3, :3] @ self.origin
        return replace(cameras, viewmats=viewmats)

    def enter_cameras(self, cameras: Cameras) -> Cameras:
        """World to canonical."""
        viewmats = cameras.viewmats.astype(np.float64)
        shift = viewmats[:, :3, 3] + viewmats[:, :3, :3] @ self.origin
        viewmats[:, :3, 3] = shift / self.unit
        return replace(cameras, viewmats=viewmats)


def find_frame(scene: Scene) -> Frame:
    """The canonical frame of a scene: median mean (float64) and median depth of its valid Gaussians.

    Raises:
        ValueError: If no Gaussian is valid.
    """
    rows = np.flatnonzero(scene.valid)
    if len(rows) == 0:
        raise ValueError("expected at least one valid Gaussian, got none")
    rows = rows[:: max(1, len(rows) // SAMPLES)]
    return Frame(lower_median(scene.gaussians.means[rows].astype(np.float64)), _unit(scene_depth(scene)))


def find_unaligned_frame(scene: Scene) -> Frame:
    """The canonical frame of an unaligned scene: median mean, and median depth of the Gaussians inside the views.

    Raises:
        ValueError: If there is no Gaussian or no view.
    """
    if len(scene.gaussians) == 0 or len(scene) == 0:
        raise ValueError(f"expected Gaussians and views, got {len(scene.gaussians)} and {len(scene)}")
    means = scene.gaussians.means[:: max(1, len(scene.gaussians) // SAMPLES)].astype(np.float64)
    return Frame(lower_median(means), _unit(scene_depth(scene)))


def _unit(depth: float) -> float:
    """The power of two nearest to a depth."""
    return 2.0 ** round(math.log2(depth)) if depth > 0 and math.isfinite(depth) else 1.0


def scene_depth(scene: Scene) -> float:
    """Median depth of a sample of the Gaussians, each in its own view, or in all that see it; 0 where none does."""
    if scene.aligned:
        rows = np.flatnonzero(scene.valid)
        rows = rows[:: max(1, len(rows) // SAMPLES)]
        means, viewmats = scene.gaussians.means[rows].astype(np.float64), scene.cameras.viewmats
        viewmats = viewmats[rows // scene.pixels_per_view]
        return float(lower_median(np.abs((viewmats[:, 2, :3] * means).sum(1) + viewmats[:, 2, 3])))
    means = scene.gaussians.means[:: max(1, len(scene.gaussians) // SAMPLES)].astype(np.float64)
    views = scene.cameras[:: max(1, len(scene) // MAX_VIEWS)]
    pixels, depths = project(means, views)
    seen = (depths > 0) & ((pixels > 0) & (pixels < (views.width, views.height))).all(-1)
    return float(lower_median(depths[seen])) if seen.any() else 0.0


def scene_frame(scene: Scene) -> Frame:
    """The canonical frame of a scene of either kind.

    Raises:
        ValueError: As :func:`find_frame` and :func:`find_unaligned_frame`.
    """
    return find_frame(scene) if scene.aligned else find_unaligned_frame(scene)


def canonicalise(scene: Scene, frame: Frame | None = None) -> tuple[Scene, Frame]:
    """The scene in its canonical frame, or in a given one, and the frame."""
    frame = frame or scene_frame(scene)
    return replace(scene, gaussians=frame.enter(scene.gaussians), cameras=frame.enter_cameras(scene.cameras)), frame


@dataclass(frozen=True, eq=False)
class PreparedScene:
    """A scene that the stages can work on.

    Args:
        given: The scene as it was given, in its own world frame.
        scene: The canonical scene: every view once; an unaligned one has cameras, images and only finite Gaussians.
        pictures: ``[v,h,w,3]`` what superpixels are cut from: the photos, or the Gaussians' own colours.
        frame: The canonical frame.
        settings: What was asked for.
        options: The same, with any budget less what ``hidden`` takes of it.
        limits: What is known of the number of Gaussians.
        members: The Gaussians as members of groups; None where the superpixels decide who belongs to them.
        checkpoint: Networks that correct the analytic stages; None: those alone.
        tree: All ways to cut the scene into fewer superpixels, where a count is asked for; None elsewhere.
        hidden: Gaussians in place of those that no view sees, canonical; None without any.
        photo_views: Views whose photos a fit may use, see :mod:`gsmerge.stages.check_photos`.
        moved: Whether views were moved to where their photos agree, before a fit or by it.
        repeated: Of every given view its place in the scene, or that of the view that it repeats.
    """

    given: Scene
    scene: Scene
    pictures: np.ndarray
    frame: Frame
    settings: CompactOptions
    options: CompactOptions
    limits: CountLimits
    members: Members | None
    checkpoint: Checkpoint | None
    tree: RegionTree | None
    hidden: Gaussians | None
    photo_views: tuple[int, ...]
    moved: bool
    repeated: tuple[int, ...]

    def scored_views(self) -> list[int]:
        """The given views that input and result are scored on: some of those whose photos show the scene.

        More of them where a quality was asked for, which depends on the scores.
        """
        candidates: Sequence[int] = range(len(self.given))
        if self.photo_views:  # numbers of the scene without repeated views
            candidates = [view for view, place in enumerate(self.repeated) if place in self.photo_views]
        choose = report_views if self.options.budget.target_psnr is None else scored_views
        return [candidates[i] for i in choose(len(candidates))]

    def with_cameras(self, cameras: Cameras) -> PreparedScene:
        """Replace the canonical cameras by those of a fit, and keep them fixed; the scene's own change nothing."""
        if cameras is self.scene.cameras:
            return self
        fixed = replace(self.options.fit, poses="fixed")
        scene = replace(self.scene, cameras=cameras)
        return replace(self, scene=scene, options=replace(self.options, fit=fixed), moved=True)

    def final_cameras(self) -> Cameras:
        """The given views' cameras as the result was made from them, in the world."""
        given = self.given.cameras
        if not self.moved:
            return given
        return replace(given, viewmats=self.frame.leave_cameras(self.scene.cameras).viewmats[list(self.repeated)])

    def candidates(self, members: Members) -> list[NetworkContext | None]:
        """What corrects the analytic stages: networks, None for nothing, or both in turn where they compete."""
        if self.checkpoint is None:
            return [None]
        from gsmerge.networks.apply import NetworkContext

        options = self.options
        networks = NetworkContext(self.checkpoint.networks, members, self.scene.cameras, options.seed)
        return [networks, None] if options.checkpoint == "auto" else [networks]

    def keeps_all(self, count: int | None) -> bool:
        """Whether so many Gaussians are asked for that an unaligned scene need not be grouped."""
        return count is not None and not self.scene.aligned and count >= len(self.scene.gaussians)


def prepare(scene: Scene, settings: CompactOptions, frame: Frame | None = None) -> PreparedScene:
    """Everything that is known before superpixels are chosen.

    Args:
        scene: As given.
        settings: Of all stages.
        frame: Canonical frame; None: the scene's own.

    Raises:
        ValueError: If there is no finite Gaussian, or there are images without cameras.
        UsageError: If the settings ask for what the scene does not have.
    """
    if settings.method != "gsmerge":  # baselines set nothing aside and learn nothing
        settings = replace(settings, contribution=ContributionOptions(), checkpoint="none", require_checkpoint=False)
    if scene.images is None and settings.budget.quality is not None:
        raise UsageError("a quality target needs photos, and the scene has none; give --images, or a --budget")
    if scene.images is None and settings.clean.drop_sky:
        raise UsageError("drop_sky: expected photos, which say where the sky is; name them with --images")
    with stage("prepare"):
        own, options, repeated = drop_repeats(scene, settings)
        if scene.images is None:  # nothing says where cameras belong
            options = replace(options, fit=replace(options.fit, poses="fixed"))
        canonical: Scene
        members, hidden, moved = None, None, False
        if own.aligned:
            aligned_scene, frame = canonicalise(own, frame)
            aligned_scene, options, shown = leave_out_photos(aligned_scene, options)
            canonical, options = move_wrong_views(aligned_scene, options, shown)
            members, moved = scene_members(canonical), canonical is not aligned_scene
        else:
            unaligned, frame = canonicalise(add_views(own), frame)
            unaligned, options, shown = leave_out_photos(unaligned, options)
            unaligned, options, hidden = split_unseen(unaligned, options)
            canonical = add_pictures(unaligned)
        photos, aligned = scene.images is not None, scene.aligned
        name = options.networks(photos=photos, aligned=aligned)
        checkpoint, notes = find_networks(name, options)
        for text in notes:
            note(text)
        options = choose_superpixels(canonical, members, options)
        limits, pictures = count_limits(canonical, options), scene_pictures(canonical)
        pixels = max(1, len(canonical) * canonical.pixels_per_view)
        options = replace(options, fit=options.fit.with_steps_for((limits.count or limits.default) / pixels))
    prepared = PreparedScene(
        scene, canonical, pictures, frame, settings, options, limits, members, checkpoint, None, hidden, shown, moved,
        repeated,
    )  # fmt: skip
    if settings.method != "gsmerge" or not (options.needs_tree or limits.count is not None):
        return prepared
    with stage("segment"):
        return with_tree(prepared)


def move_wrong_views(scene: Scene, options: CompactOptions, views: tuple[int, ...]) -> tuple[Scene, CompactOptions]:
    """The canonical scene with its views where the photos agree, as far as ``poses`` asks for it; and the options.

    Where it leaves that to the scene, the options say what came of it: the fit moves the cameras on, or it does not.
    """
    poses = options.fit.poses
    if scene.images is None or options.method != "gsmerge" or poses == "fixed":
        return scene, options
    moved = align_views(scene, views, always=poses == "free")
    if poses == "auto":
        options = replace(options, fit=replace(options.fit, poses="fixed" if moved is None else "free"))
    return scene if moved is None else moved, options


def find_networks(name: str, options: CompactOptions) -> tuple[Checkpoint | None, list[str]]:
    """The checkpoint of this name, which gives what the options ask, and notes; None for ``"none"``.

    Raises:
        SceneError: If it is required and cannot be used.
        UsageError: If it does not give what the options ask for.
    """
    if name == "none":  # torch is imported only where there are networks
        return None, []
    from gsmerge.networks.checkpoint import find_checkpoint

    checkpoint, notes = find_checkpoint(name, required=options.require_checkpoint)
    if checkpoint is not None:
        check_networks(checkpoint, options)
    return checkpoint, notes


def check_networks(checkpoint: Checkpoint, options: CompactOptions) -> None:
    """Do the networks give what the options ask of them?

    Raises:
        UsageError: If not.
    """
    outputs = checkpoint.networks.options.outputs
    if options.recipe == "paper" and outputs != "absolute":
        raise UsageError(
            f"recipe paper: expected networks with absolute outputs, {checkpoint.path} has {outputs} ones;"
            " gsmerge train --preset paper makes them"
        )
    require_children("k", options.decode.max_k, checkpoint)


def require_children(name: str, count: int, checkpoint: Checkpoint | None) -> None:
    """Raise UsageError where the heads of a checkpoint know fewer children than option ``name`` asks for."""
    if checkpoint is not None and count > checkpoint.networks.max_children:
        raise UsageError(
            f"{name}: expected at most {checkpoint.networks.max_children} with the absolute outputs of"
            f" {checkpoint.path}, got {count}"
        )


def drop_repeats(scene: Scene, options: CompactOptions) -> tuple[Scene, CompactOptions, tuple[int, ...]]:
    """The scene with every view once, the options with budgets that stay shares of the whole, and places of views."""
    views, places = distinct_views(scene)
    if len(views) == len(scene):
        return scene, options, tuple(places)
    few = subset(scene, views)
    count = exact_count(options.budget, scene.num_gaussians, scene.gaussians.sh_degree)
    if count is not None:
        options = replace(options, budget=replace(options.budget, budget=min(count, few.num_gaussians)))
    note(f"{len(scene) - len(views)} views repeat others in every pixel and count once")
    return few, options, tuple(places)
