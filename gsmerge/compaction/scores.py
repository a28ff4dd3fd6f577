"""Scores of the input and of a result, as PSNR against photos or renders of the input."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmerge.compaction.report import Covered, PhotoFiles
from gsmerge.facts.prepare import Prepared
from gsmerge.io.formats.rounding import round_as_written
from gsmerge.photos.views import scored_views
from gsmerge.plan import Plan
from gsmerge.raster.photos import NEAR_PLANE, WHOLE_SHARE, PhotoScore, scene_photos, score_photos
from gsmerge.runtime.record import stage
from gsmerge.stages.prune import ROUNDING
from gsmerge.types import Gaussians, Scene

# A sample of the scored photos takes one of INPUT_EVERY tiles for the input. For a result it takes one of RESULT_EVERY,
# because far fewer Gaussians are drawn faster. On fifteen captures a gain is then off by .27 dB (rms)
INPUT_EVERY, RESULT_EVERY = 10, 2


def compares_all_pixels(before: PhotoScore | None) -> bool:
    """Return whether results are compared with their input over all pixels, rather than over those that it covers.

    ``before`` is the score of the input. All pixels count if the input covers nearly all of them, if it covers none, or
    if it has no score.
    """
    return before is None or before.share >= WHOLE_SHARE or not math.isfinite(before.covered_psnr)


def measure_renders(gaussians: Gaussians, prepared: Prepared, plan: Plan) -> PhotoScore:
    """Score canonical Gaussians against renders of the input in the scored views."""
    return score_photos(gaussians, scene_photos(prepared.scene), plan.scored_views, covered=plan.covered)


def may_leave_gaps(prepared: Prepared, plan: Plan) -> bool:
    """Return whether more than a few pixels are black in renders of the input; it may cover nothing there."""
    pictures = (prepared.scene.images[view] for view in plan.scored_views)
    return bool(np.mean([(picture.max(-1) > ROUNDING).mean() for picture in pictures]) < WHOLE_SHARE)


def round_for_output(gaussians: Gaussians, plan: Plan) -> Gaussians:
    """Round the values of Gaussians as the output's file does; return them unchanged if no file is written."""
    return round_as_written(plan.output, gaussians) if plan.output else gaussians


def measure_result(
    gaussians: Gaussians, prepared: Prepared, plan: Plan, covered: Sequence[np.ndarray] | None = None
) -> PhotoScore | None:
    """Score Gaussians of the world, as the output's file rounds them, on the scored photos; None without photos.

    ``covered`` has a mask ``[h,w]`` for each scored photo. Then ``covered_psnr`` is measured over its pixels, on the
    sample of the input. None: over the pixels that the Gaussians themselves cover.
    """
    if not prepared.reference.of_views:
        return None
    every, shown = RESULT_EVERY if covered is None else INPUT_EVERY, prepared.result_views()
    return _score_photos("score", round_for_output(gaussians, plan), shown, prepared, plan, covered, every)


def measure_input(prepared: Prepared, plan: Plan) -> PhotoScore | None:
    """Score the input's own Gaussians on the scored photos, and over the pixels that they cover; None without photos.

    If views have Gaussians of their own, the covered pixels are those that have one.
    """
    if not prepared.reference.of_views:
        return None
    scene, shown = prepared.input_scene, prepared.scene
    if shown.empty is not None:  # where a result may show nothing, the input is not compared either
        scene = replace(scene, masks=prepared.result_views().masks)
    covered = None if scene.covered is None else list(scene.covered[list(plan.scored_views)])
    return _score_photos("input", scene.file_gaussians, scene, prepared, plan, covered)


def _score_photos(
    name: str,
    gaussians: Gaussians,
    views: Scene,
    prepared: Prepared,
    plan: Plan,
    covered: Sequence[np.ndarray] | None,
    every: int = INPUT_EVERY,
) -> PhotoScore:
    """Score Gaussians on the scored photos; ``name`` is the stage that the time counts for.

    If the plan allows samples, only one of ``every`` tiles of the photos counts.
    """
    with stage(name):
        near, every, photos = NEAR_PLANE * prepared.frame.unit, every if plan.samples else 1, scene_photos(views)
        return score_photos(gaussians, photos, plan.scored_views, every=every, near=near, covered=covered)


def _measure_covered(before: PhotoScore | None, gaussians: Gaussians, prepared: Prepared, plan: Plan) -> Covered | None:
    """Score a result over the pixels that the input covers; ``before`` is the score of the input.

    None if all pixels are compared, or if photos count only where the input covers them anyway.
    """
    if before is None or compares_all_pixels(before) or prepared.scene.empty is not None:
        return None
    after = measure_result(gaussians, prepared, plan, before.covered)
    return None if after is None else Covered(before.share, before.covered_psnr, after.covered_psnr)


def _measure_on_files(gaussians: Gaussians, prepared: Prepared, plan: Plan) -> float | None:
    """Score Gaussians of the world on photos as their files have them; None if no scored photo was changed."""
    files = prepared.reference.photo_files
    if files is None:
        return None
    shown = prepared.result_views()
    if shown.images is None or all(np.array_equal(shown.images[view], files[view]) for view in plan.scored_views):
        return None
    return _score_photos("score", gaussians, replace(shown, images=files), prepared, plan, None).psnr


def _measure_protected(gaussians: Gaussians, prepared: Prepared, plan: Plan) -> PhotoScore | None:
    """Score Gaussians of the world over the protected pixels of the views that have some; None if no view has any.

    The share of the score is the share of protected pixels in all photos.
    """
    if not prepared.reference.of_views or prepared.input_scene.protected is None:
        return None
    with stage("score"):
        shown = prepared.result_views()
        assert shown.protected is not None
        protected_views = np.flatnonzero(shown.protected.any((1, 2))).tolist()
        views = [protected_views[i] for i in scored_views(len(protected_views))]
        near, masks = NEAR_PLANE * prepared.frame.unit, list(shown.protected[views])
        score = score_photos(gaussians, scene_photos(shown), views, near=near, covered=masks)
        return replace(score, share=float(shown.protected.mean()))


@dataclass(frozen=True)
class InputScores:
    """Scores of an input, with which a result is compared; each is None if it cannot be measured."""

    photos: PhotoScore | None  # On the scored views
    on_files: float | None  # On the photos as their files have them, if the run changed some, dB
    protected: PhotoScore | None  # Over protected pixels


def score_input(prepared: Prepared, plan: Plan) -> InputScores:
    """Score the input's own Gaussians; the score on the scored views is taken from the plan if it has one."""
    photos, gaussians = plan.before or measure_input(prepared, plan), prepared.input_scene.file_gaussians
    return InputScores(
        photos, _measure_on_files(gaussians, prepared, plan), _measure_protected(gaussians, prepared, plan)
    )


@dataclass(frozen=True)
class PartScores:
    """PSNR of input and result over parts of the pixels, and on photos before the run changed them.

    None where there is no such part or change. The names are those of
    :class:`gsmerge.compaction.report.CompactReport`.
    """

    covered: Covered | None = None
    photo_files: PhotoFiles | None = None
    protected: Covered | None = None


def measure_parts(before: InputScores, gaussians: Gaussians, prepared: Prepared, plan: Plan) -> PartScores:
    """Score a result over covered and over protected pixels, and on photos as their files have them.

    ``before`` are the scores of the input.
    """
    covered, rounded = _measure_covered(before.photos, gaussians, prepared, plan), round_for_output(gaussians, plan)
    after = None if before.on_files is None else _measure_on_files(rounded, prepared, plan)
    files = None if before.on_files is None or after is None else PhotoFiles(before.on_files, after)
    score = None if before.protected is None else _measure_protected(rounded, prepared, plan)
    protected = score and before.protected and (score.share, before.protected.covered_psnr, score.covered_psnr)
    return PartScores(covered, files, Covered(*protected) if protected else None)
