"""Scene -> prepared scene: take the steps that bring a scene to what the stages need."""

from __future__ import annotations

from collections.abc import Sequence

from gsmerge.frozen import replace
from gsmerge.method.facts.pictures import PHOTOS, ROW_COLORS
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.geometry.frame import Frame
from gsmerge.method.viewpoints.place_cameras import NO_VIEWS, VIEWER_VIEWS, place_inside
from gsmerge.prepare.repeats import without_repeats
from gsmerge.prepare.row_colors import NO_PHOTOS
from gsmerge.prepare.steps import RULES, STEPS, Step, begin, has_changed, select, take_steps
from gsmerge.runtime.record import record_choices, record_part, stage
from gsmerge.settings.stages import PrepareOptions
from gsmerge.types import Scene


@stage("prepare")
def prepare(
    scene: Scene, options: PrepareOptions | None = None, frame: Frame | None = None, *, steps: Sequence[Step] = STEPS
) -> Prepared:
    """Bring a scene to what the stages need; notes name missing data and what replaces it.

    Repeated views are dropped, and views are placed if there are none. Rows and photos are compared: photos that show
    the scene get its tones and its exposure, and views move to where they agree. Then holes are filled, and what no
    view sees is drawn. :attr:`Prepared.changes` says what was done, and so does the record of the run.

    ``frame`` is the canonical frame; None stands for the scene's own frame. Fewer ``steps`` are enough for a part of a
    larger scene, or if no stage needs pixels. Raises ValueError if there is no finite Gaussian, or if there are images
    without cameras.
    """
    prepared = take_steps(steps, begin(scene, frame), options)
    if prepared.changes:
        record_choices(changes=list(prepared.changes))
    return prepared


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
        given = take_steps(select("frame", "pixels", *RULES, "background"), begin(scene))
        prepared = take_steps(select("photos", "row colours"), given)
        if prepared.reference.name == ROW_COLORS:
            return replace(scene, images=prepared.scene.images, masks=prepared.scene.masks), False
        prepared = take_steps(select("exposure"), prepared)
    views = prepared.reference.score_views if prepared.reference.name == PHOTOS else ()
    if given.scene.masks is not scene.masks:
        scene = replace(scene, masks=given.scene.masks)
    left_out = len(views) < len(given.scene.photo_views)
    return scene, left_out or has_changed(given.scene.images, prepared.scene, views, given.repeated)
