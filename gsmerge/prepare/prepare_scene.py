"""Scene -> prepared scene: the scene in its canonical frame, and facts about it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmerge.frozen import replace
from gsmerge.geometry.frame import Frame, canonicalise
from gsmerge.prepare.compare_photos import compare_photos
from gsmerge.prepare.confirm_depths import confirm_depths
from gsmerge.prepare.draw_left_out import draw_left_out, mask_background
from gsmerge.prepare.draw_outside import draw_outside
from gsmerge.prepare.exposure import equalise_exposure
from gsmerge.prepare.fill_holes import fill_holes
from gsmerge.prepare.move_poses import move_poses
from gsmerge.prepare.place_cameras import HELD_OUT, NO_VIEWS, VIEWER_VIEWS, add_views, draw_pictures, place_inside
from gsmerge.prepare.prepared import Prepared, Reference, with_photos
from gsmerge.prepare.repeats import without_repeats
from gsmerge.prepare.row_colors import NO_PHOTOS, PHOTOS, RENDERS, ROW_COLORS, add_row_colors
from gsmerge.prepare.true_pixels import raise_sizes, with_pixels
from gsmerge.raster.photos import counting_pixels
from gsmerge.runtime.record import note, record_choices, record_part, stage
from gsmerge.settings.stages import PrepareOptions
from gsmerge.types import PicturedScene, Scene


@stage("prepare")
def prepare(
    scene: Scene,
    options: PrepareOptions | None = None,
    frame: Frame | None = None,
    *,
    fill: bool = True,
    outside: bool = True,
    pixels: bool = True,
) -> Prepared:
    """Bring a scene to what the stages need; notes name missing data and what replaces it.

    Repeated views are dropped, and views are placed if there are none. Rows and photos are compared: photos that show
    the scene get its tones and its exposure, and views move to where they agree. Then holes are filled, and what no
    view sees is drawn.

    ``frame`` is the canonical frame; None stands for the scene's own frame. With ``fill``, Gaussians are added at
    pixels that only pictures show. With ``outside``, pictures of Gaussians that no view sees are drawn; it is False if
    other views of a larger scene see these Gaussians. With ``pixels``, the pixels of placed views are found, which
    superpixels need. Raises ValueError if there is no finite Gaussian, or if there are images without cameras.
    """
    options = options or PrepareOptions()
    input_scene, placed = replace(scene, depths=None), len(scene) == 0  # depth maps serve for holes alone
    scene, repeated, notes = without_repeats(scene)
    for text in notes:
        note(text)
    scene, frame = canonicalise(add_views(scene), frame)
    scene = raise_sizes(with_pixels(scene) if pixels or not placed else scene, placed=placed)
    scene, reference = choose_pictures(scene, options, placed=placed)
    is_moved, files = False, input_scene.images
    if reference.of_views:
        input_scene = with_photos(input_scene, scene, repeated)
    if scene.has_own_pixels:  # each view's Gaussians have the exposure and the pose of the view
        scene = equalise_exposure(scene, reference.score_views, options.exposure)
        if options.poses != "fixed":
            moved = move_poses(scene, reference.score_views, always=options.poses == "free")
            is_moved, scene = moved is not None, moved or scene
    if reference.name == PHOTOS and files is not None and _has_changed(files, scene, reference.score_views, repeated):
        reference = replace(reference, photo_files=files)
    agreement = confirm_depths(scene)
    if agreement is not None:
        record_choices(agreement=agreement.to_dict())
        if agreement.advice:
            note(agreement.advice)
    if fill and reference.of_views:
        views, shown, masks = reference.score_views, np.zeros(scene.images.shape[:3], bool), scene.masks
        has_row_colors = reference.name == ROW_COLORS  # these pictures have colours at all pixels
        shown[list(views)] = True if has_row_colors or masks is None else masks[list(views)]
        scene = fill_holes(scene, shown, everywhere=options.extent == "photos")
        scene = draw_left_out(replace(scene, depths=None), masks)
        if scene.empty is not None and scene.masks is not None:  # views that count nowhere any more are not scored
            seen = tuple(view for view in views if scene.masks[view].any())
            reference = replace(reference, score_views=seen or views)
    if outside and not scene.has_own_pixels and not placed:
        drawn = draw_outside(scene)
        if reference.name == RENDERS and drawn is not scene:  # all pixels of all pictures are drawings
            views = (*reference.score_views, *range(len(scene), len(drawn)))
            drawn, reference = replace(drawn, masks=None), replace(reference, score_views=views)
        scene = drawn
    return Prepared(input_scene, scene, frame, reference, tuple(repeated), is_moved, agreement)


def choose_pictures(scene: Scene, options: PrepareOptions, *, placed: bool) -> tuple[PicturedScene, Reference]:
    """Return a canonical scene with the pictures to which results are fitted, and how they are used.

    Photos that show the scene are used first. If no photo shows the scene, a view's picture has the colours of its
    Gaussians, or if views share Gaussians, it is a render. ``placed`` is true if the scene had no views.
    """
    has_photos, every = scene.images is not None, tuple(range(len(scene)))
    if scene.images is not None:
        pictured = PicturedScene.with_pictures(scene, scene.images, scene.masks)
        if options.extent != "photos" and options.look != "scene":
            pictured = mask_background(pictured)  # before photos are compared, which show nothing of the scene there
        pictured, views = compare_photos(pictured, options.look)
        if views:
            return pictured, Reference(PHOTOS, views)
    scene = replace(scene, images=None, large_photos=None, masks=None)
    if scene.has_own_pixels:
        return add_row_colors(scene, has_photos=has_photos), Reference(ROW_COLORS, every)
    reason = "photos do not count" if has_photos else "no photos, and the rows are not the pixels of the views"
    remedy = "" if has_photos else "; name photos with --images"
    if not placed:  # if views were placed, another note has said this
        note(f"{reason}: renders of the scene itself are used instead{remedy}")
    drawn, scored = draw_pictures(scene), every[: len(every) // HELD_OUT] if placed else every
    shown = tuple(view for view in scored if drawn.images[view].any())  # any result is right in an empty view
    return drawn, Reference(RENDERS, shown or scored, placed)


def _has_changed(photos: np.ndarray, scene: PicturedScene, views: Sequence[int], repeated: Sequence[int]) -> bool:
    """Return whether preparation changed a pixel of the input's ``photos`` that counts in scores of ``views``.

    ``repeated`` has the index in the ``scene`` of each photo's view.
    """
    if scene.images is photos:
        return False
    counting = counting_pixels(scene)
    return any(
        not np.array_equal(before[counting[view]], scene.images[view][counting[view]])
        for before, view in zip(photos, repeated, strict=True)
        if view in views
    )


def views_notes(scene: Scene) -> list[str]:
    """Return the notes of a run about repeated views and about missing views or photos; no colours are compared."""
    if len(scene) == 0:
        return [NO_VIEWS if place_inside(scene.gaussians) is None else VIEWER_VIEWS]
    return [*without_repeats(scene)[2], *([NO_PHOTOS] if scene.images is None and scene.is_shown else [])]


def scored_pictures(scene: Scene) -> tuple[Scene, bool]:
    """Return a scene with its pictures for scores, and whether :func:`prepare` would change these pictures.

    The pictures are the photos. If photos are missing, have another look, or do not show the scene, and each Gaussian
    belongs to one view, a view's picture has the colours of its Gaussians.
    """
    has_pictures = scene.has_own_pixels or scene.images is not None
    if len(scene) == 0 or len(scene.gaussians) == 0 or not has_pictures:
        return scene, False
    with record_part(silent=True):
        canonical = canonicalise(scene)[0]
        if scene.images is not None:
            given = mask_background(with_pixels(PicturedScene.with_pictures(canonical, scene.images, scene.masks)))
            compared, views = compare_photos(given)
            if views or not scene.has_own_pixels:
                if canonical.has_own_pixels:
                    compared = equalise_exposure(compared, views, "auto")
                left_out = len(views) < len(given.photo_views)
                if given.masks is not canonical.masks:
                    scene = replace(scene, masks=given.masks)
                return scene, left_out or _has_changed(given.images, compared, views, range(len(given)))
        colored = add_row_colors(replace(canonical, images=None, large_photos=None, masks=None))
    return replace(scene, images=colored.images, masks=colored.masks), False
