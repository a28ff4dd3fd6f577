"""The steps that prepare a scene, in their order: each makes a prepared scene of another.

A step that changes photos, cameras or Gaussians says so in :attr:`Prepared.changes`, in one sentence. A step that has
nothing to do returns its argument. Code that needs only a part, such as the pixels, takes fewer steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np

from gsmerge.arrays import max_columns
from gsmerge.errors import USUAL, Note, count_words
from gsmerge.frozen import dataclass, replace
from gsmerge.method.facts.pictures import PHOTOS, RENDERS, ROW_COLORS
from gsmerge.method.facts.prepared import Prepared, Reference, with_photos
from gsmerge.method.geometry.frame import Frame, canonicalise
from gsmerge.method.raster.photos import counting_pixels, row_shares
from gsmerge.method.viewpoints.place_cameras import HELD_OUT, describe_dropped, draw_pictures, keep_finite, place_views
from gsmerge.prepare.blurred import leave_out_blurred
from gsmerge.prepare.compare_photos import compare_photos
from gsmerge.prepare.confirm_depths import confirm_depths
from gsmerge.prepare.draw_left_out import draw_left_out, mask_background
from gsmerge.prepare.draw_outside import draw_outside
from gsmerge.prepare.edits import follow_edits
from gsmerge.prepare.exposure import equalise_exposure
from gsmerge.prepare.fill_holes import MOST_EMPTY, fill_holes
from gsmerge.prepare.masked_rows import drop_masked
from gsmerge.prepare.move_poses import move_poses
from gsmerge.prepare.overlays import leave_out_overlays
from gsmerge.prepare.passers_by import leave_out_passers
from gsmerge.prepare.repeats import without_repeats
from gsmerge.prepare.row_colors import add_row_colors
from gsmerge.prepare.true_pixels import raise_sizes, with_pixels
from gsmerge.prepare.vignette import divide_by_vignette
from gsmerge.runtime.record import list_some, note, record_choices
from gsmerge.settings.stages import PrepareOptions
from gsmerge.types import PicturedScene, Scene

WORLD = Frame(np.zeros(3), 1.0)  # the frame of a scene as it was read


StepFunction = Callable[[Prepared, PrepareOptions], Prepared]


@dataclass(frozen=True)
class Step:
    """One step of preparing a scene."""

    name: str
    take: StepFunction


def begin(scene: Scene, frame: Frame | None = None) -> Prepared:
    """Return a scene as it was read, before the first step.

    ``frame`` is the canonical frame that the step "frame" enters; None stands for the scene's own frame.
    """
    return Prepared(
        input_scene=replace(scene, depths=None),  # depth maps serve for holes alone
        scene=cast("PicturedScene", scene),  # whose pictures are not chosen yet
        frame=WORLD if frame is None else frame,
        reference=Reference("", (), photo_files=scene.images),
        repeated=tuple(range(len(scene))),
        moved=False,
    )


def take_steps(steps: Sequence[Step], prepared: Prepared, options: PrepareOptions | None = None) -> Prepared:
    """Take steps one after another; ``options`` None: the defaults."""
    for step in steps:
        prepared = step.take(prepared, options or PrepareOptions())
    return prepared


def select(*names: str) -> tuple[Step, ...]:
    """Return the steps of these names, in their order."""
    return tuple(step for step in STEPS if step.name in names)


def without(*names: str) -> tuple[Step, ...]:
    """Return all steps but those of these names; ValueError if there is no step of a name."""
    unknown = sorted(set(names) - {step.name for step in STEPS})
    if unknown:
        raise ValueError(f"expected steps among {', '.join(step.name for step in STEPS)}, got {', '.join(unknown)}")
    return tuple(step for step in STEPS if step.name not in names)


def drop_repeats(p: Prepared, _: PrepareOptions) -> Prepared:
    """Keep one of several views that are equal in every pixel."""
    scene, repeated, notes = without_repeats(p.scene)
    return p.after("".join(notes), scene=scene, repeated=tuple(repeated))


def drop_nonfinite(p: Prepared, _: PrepareOptions) -> Prepared:
    """Leave out Gaussians that are not finite."""
    scene = keep_finite(p.scene)
    count = len(p.scene.gaussians) - len(scene.gaussians)
    return p.after(describe_dropped(count) if count else "", scene=scene)


def place_missing_views(p: Prepared, _: PrepareOptions) -> Prepared:
    """Place views in a scene that has none, with a note."""
    if len(p.scene):
        return p
    scene = place_views(p.scene)
    return p.after("", scene=scene, reference=Reference("", (), placed=True))


def enter_frame(p: Prepared, _: PrepareOptions) -> Prepared:
    """Move the scene into its canonical frame, or into the frame of all parts of a larger scene."""
    scene, frame = canonicalise(p.scene, None if p.frame is WORLD else p.frame)
    return p.after("", scene=scene, frame=frame)


def raise_tiny_sizes(p: Prepared, _: PrepareOptions) -> Prepared:
    """Raise the sizes of Gaussians that the low-pass hides."""
    scene, change = raise_sizes(p.scene, placed=p.reference.placed)
    return p.after(change, scene=scene)


def drop_masked_rows(p: Prepared, _: PrepareOptions) -> Prepared:
    """Leave out the Gaussians of masked pixels that other views contradict, but not at the border of a crop."""
    if p.scene.region is not None:
        return p
    return _leave_out(p, *drop_masked(p.scene))


def leave_out_by(rule: Callable[[PicturedScene], tuple[Scene, np.ndarray | None, str]]) -> StepFunction:
    """Return a step that applies a rule to the photos, unless a look was asked for.

    The rule returns the scene without what it leaves out, these pixels ``[v,h,w]`` or None, and a sentence.
    """

    def apply(p: Prepared, options: PrepareOptions) -> Prepared:
        """Apply the rule."""
        if p.scene.images is None or options.look != "auto":
            return p
        return _leave_out(p, *rule(PicturedScene.with_pictures(p.scene, p.scene.images, p.scene.masks)))

    return apply


def follow_scene_edits(p: Prepared, options: PrepareOptions) -> Prepared:
    """Let photos follow what was edited in the scene after they were taken."""
    if p.reference.placed or options.look != "auto":
        return p
    scene, change = follow_edits(p.scene)
    return p.after(change, scene=scene) if change else p


def leave_out_background(p: Prepared, options: PrepareOptions) -> Prepared:
    """Leave out the uniform background of photos of an object, before photos are compared.

    Photos show nothing of the scene there.
    """
    if p.scene.images is None or options.extent == "photos" or options.look == "scene":
        return p
    scene, change = mask_background(PicturedScene.with_pictures(p.scene, p.scene.images, p.scene.masks))
    return p.after(change, scene=scene)


def use_photos(p: Prepared, options: PrepareOptions) -> Prepared:
    """Use the photos, corrected, if they show the scene; photos that do not show it are replaced."""
    if p.scene.images is None:
        return p
    pictured = PicturedScene.with_pictures(p.scene, p.scene.images, p.scene.masks)
    scene, views, changes = compare_photos(pictured, options.look)
    if not views:
        return p
    reference = Reference(PHOTOS, views, photo_files=p.reference.photo_files)
    return p.after(*changes, scene=scene, reference=reference)


def use_row_colors(p: Prepared, _: PrepareOptions) -> Prepared:
    """Use the colours of each view's own Gaussians if no photo shows the scene."""
    if p.reference.name or not p.scene.has_own_pixels:
        return p
    has_photos = p.scene.images is not None
    scene, change = add_row_colors(_without_photos(p), has_photos=has_photos)
    return p.after(change, scene=scene, reference=Reference(ROW_COLORS, tuple(range(len(scene)))))


def use_renders(p: Prepared, _: PrepareOptions) -> Prepared:
    """Use renders of the Gaussians if there is no other picture, with a note."""
    if p.reference.name:
        return p
    has_photos = p.scene.images is not None
    placed = p.reference.placed
    every = tuple(range(len(p.scene)))
    if not (placed or has_photos):  # if views were placed, another note has said this
        problem = "no photos, and the rows are not the pixels of the views"
        note(f"{problem}: renders of the scene itself are used instead; name photos with --images")
    drawn = draw_pictures(_without_photos(p))
    scored = every[: len(every) // HELD_OUT] if placed else every
    shown = tuple(view for view in scored if drawn.images[view].any())  # any result is right in an empty view
    change = f"photos do not count: {RENDERS} are used instead" if has_photos else ""
    return p.after(change, scene=drawn, reference=Reference(RENDERS, shown or scored, placed))


def give_input_pictures(p: Prepared, _: PrepareOptions) -> Prepared:
    """Give the scene as it was read the pictures of its views, with which it is compared."""
    if not p.reference.of_views:
        return p
    return replace(p, input_scene=with_photos(p.input_scene, p.scene, p.repeated))


def equalise_exposures(p: Prepared, options: PrepareOptions) -> Prepared:
    """Bring photos, and the Gaussians of their pixels, to one exposure if exposures differ at random."""
    if p.scene.pixels is None or not p.reference.of_views:
        return p
    scene, change = equalise_exposure(p.scene, p.reference.score_views, options.exposure)
    return p.after(change, scene=scene)


def move_wrong_poses(p: Prepared, options: PrepareOptions) -> Prepared:
    """Move cameras, with the Gaussians of their pixels, to where their photos agree, if poses are wrong."""
    if not p.scene.has_own_pixels or options.poses == "fixed":
        return p
    scene = move_poses(p.scene, p.reference.score_views, always=options.poses == "free")
    if scene is None:
        return p
    count = sum(map(np.any, scene.cameras.viewmats != p.scene.cameras.viewmats))
    change = f"{count} of {len(scene)} cameras, and the Gaussians of their pixels, moved to where photos agree"
    return p.after(change, scene=scene, moved=True)


def keep_changed_files(p: Prepared, _: PrepareOptions) -> Prepared:
    """Keep the photos as they were read if a step changed one that counts."""
    files = p.reference.photo_files
    reference = p.reference
    if files is None or has_changed(files, p.scene, reference.score_views, p.repeated):
        return p
    return replace(p, reference=replace(reference, photo_files=None))


def measure_agreement(p: Prepared, _: PrepareOptions) -> Prepared:
    """Measure how much of the depth other views confirm, with a note if a result will be poor."""
    agreement = confirm_depths(p.scene)
    if agreement is None:
        return p
    record_choices(agreement=agreement.to_dict())
    if agreement.advice:
        note(agreement.advice)
    return replace(p, agreement=agreement)


def fill_scene(p: Prepared, options: PrepareOptions) -> Prepared:
    """Fill holes with Gaussians, and draw what photos leave out."""
    if not p.reference.of_views:
        return p
    views = list(p.reference.score_views)
    masks = p.scene.masks
    shown = np.zeros(p.scene.images.shape[:3], bool)
    has_row_colors = p.reference.name == ROW_COLORS  # these pictures have colours at all pixels
    shown[views] = True if has_row_colors or masks is None else masks[views]
    if p.foreign is not None:
        shown |= p.foreign  # what no other view sees there is filled from beside
    filled = fill_holes(p.scene, shown, everywhere=options.extent == "photos")
    scene = draw_left_out(replace(filled, depths=None), masks)
    count = len(scene.gaussians) - len(p.scene.gaussians)
    added = f"{count_words(count, 'Gaussian')} added at pixels that no Gaussian covered enough" if count else ""
    few = [name for name, share in zip(scene.names, row_shares(p.scene), strict=True) if share < MOST_EMPTY]
    if count and few:
        added += f"; {list_some(few)} had fewer than half as many Gaussians as views usually have"
    elif count and not p.scene.get_pixels().shown[:, [0, -1]].any():
        added += ", which is usual: the model left the borders of its pictures out, and perhaps the sky"
        added = Note(added, USUAL)
    drawn = ""
    if scene.images is not p.scene.images:
        is_drawn = np.stack([max_columns(a != b) for a, b in zip(p.scene.images, scene.images, strict=True)])
        if is_drawn.any():
            where = (
                f"{is_drawn.any((1, 2)).sum()} of {len(scene)} pictures ({100 * is_drawn.mean():.1f} % of all pixels)"
            )
            drawn = f"where a photo does not count, its picture shows what the Gaussians show: in {where}"
    return p.after(added, drawn, scene=scene)


def score_shown_views(p: Prepared, _: PrepareOptions) -> Prepared:
    """Score no view that counts nowhere any more, since holes were filled."""
    scene = p.scene
    views = p.reference.score_views
    if not p.reference.of_views or scene.empty is None or scene.masks is None:
        return p
    seen = tuple(view for view in views if scene.masks[view].any())
    return replace(p, reference=replace(p.reference, score_views=seen or views))


def draw_unseen(p: Prepared, _: PrepareOptions) -> Prepared:
    """Add pictures of Gaussians that no view sees, so that a fit keeps them."""
    if p.scene.has_own_pixels or p.reference.placed:
        return p
    drawn, change = draw_outside(p.scene)
    reference = p.reference
    if drawn is p.scene:
        return p
    if reference.name == RENDERS:  # all pixels of all pictures are drawings
        views = (*reference.score_views, *range(len(p.scene), len(drawn)))
        drawn = replace(drawn, masks=None)
        reference = replace(reference, score_views=views)
    return p.after(change, scene=drawn, reference=reference)


# Names of the steps that leave out, or follow, what people did to photos, masks and scenes
RULES = ("masked rows", "vignette", "edits", "overlays", "passers-by", "blurred")
STEPS: tuple[Step, ...] = (
    Step("repeats", drop_repeats),
    Step("finite", drop_nonfinite),
    Step("views", place_missing_views),
    Step("frame", enter_frame),
    Step("pixels", lambda p, _: p.after("", scene=with_pixels(p.scene))),
    Step("sizes", raise_tiny_sizes),
    Step("masked rows", drop_masked_rows),
    Step("vignette", leave_out_by(divide_by_vignette)),
    Step("edits", follow_scene_edits),
    Step("overlays", leave_out_by(leave_out_overlays)),
    Step("passers-by", leave_out_by(leave_out_passers)),
    Step("blurred", leave_out_by(leave_out_blurred)),
    Step("background", leave_out_background),
    Step("photos", use_photos),
    Step("row colours", use_row_colors),
    Step("renders", use_renders),
    Step("input pictures", give_input_pictures),
    Step("exposure", equalise_exposures),
    Step("poses", move_wrong_poses),
    Step("photo files", keep_changed_files),
    Step("depths", measure_agreement),
    Step("holes", fill_scene),
    Step("scored views", score_shown_views),
    Step("outside", draw_unseen),
)


def _leave_out(p: Prepared, scene: Scene, foreign: np.ndarray | None, change: str) -> Prepared:
    """Return a scene from which Gaussians were left out; in a fit, the pixels ``foreign [v,h,w]`` weigh nothing.

    With a smaller weight than usual, a fit would learn there what the input shows without these Gaussians.
    """
    if foreign is None:
        return p
    importance = np.ones(foreign.shape, np.float32) if scene.importance is None else scene.importance.copy()
    importance[foreign] = 0
    if p.foreign is not None:
        foreign = foreign | p.foreign
    return p.after(change, scene=with_pixels(replace(scene, importance=importance)), foreign=foreign)


def _without_photos(p: Prepared) -> Scene:
    """Return the scene of views whose photos do not count, with the importance that its pixels had."""
    importance = p.input_scene.importance
    if importance is not None and not p.reference.placed:
        importance = importance[[p.repeated.index(view) for view in range(len(p.scene))]]
    bare = PicturedScene.without_pictures(p.scene)
    return replace(bare, large_photos=None, masks=None, importance=importance)


def has_changed(photos: np.ndarray, scene: PicturedScene, views: Sequence[int], repeated: Sequence[int]) -> bool:
    """Return whether preparation changed a pixel of the input's ``photos`` that counts in scores of ``views``.

    ``repeated`` has the index in the ``scene`` of each photo's view.
    """
    if scene.images is photos:
        return False
    counting = counting_pixels(scene)
    return any(
        (max_columns(before != scene.images[view]) & counting[view]).any()
        for before, view in zip(photos, repeated, strict=True)
        if view in views
    )
