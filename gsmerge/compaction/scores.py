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

# In a sample of the scored photos one of so many tiles counts: of the input, and of the result, which has far fewer
# Gaussians. On fifteen captures a gain is off by .27 dB (rms)
INPUT_EVERY, RESULT_EVERY = 10, 2


def covers_all(before: PhotoScore | None) -> bool:
    """Return whether an input with the score ``before`` is compared with results over whole pictures.

    That is the case if the input covers nearly all pixels, or none; and without a score.
    """
    return before is None or before.share >= WHOLE_SHARE or not math.isfinite(before.covered_psnr)


def measure_renders(gaussians: Gaussians, prepared: Prepared, plan: Plan) -> PhotoScore:
    """Score canonical Gaussians against renders of the input in the scored views."""
    return score_photos(gaussians, scene_photos(prepared.scene), plan.scored_views, covered=plan.covered)


def may_leave_gaps(prepared: Prepared, plan: Plan) -> bool:
    """Return whether more than a few pixels are black in renders of the input, as where the input covers nothing."""
    pictures = (prepared.scene.images[view] for view in plan.scored_views)
    return bool(np.mean([(picture.max(-1) > ROUNDING).mean() for picture in pictures]) < WHOLE_SHARE)


def written(gaussians: Gaussians, plan: Plan) -> Gaussians:
    """Return Gaussians with the rounding of the output's file; unchanged if no file is written."""
    return round_as_written(plan.output, gaussians) if plan.output else gaussians


def measure_result(
    gaussians: Gaussians, prepared: Prepared, plan: Plan, covered: Sequence[np.ndarray] | None = None
) -> PhotoScore | None:
    """Score Gaussians of the world, as the output's file rounds them, on the scored photos; None without photos.

    ``covered``: a mask of pixels ``[h,w]`` of each scored photo, over which ``covered_psnr`` is measured, on the sample
    of the input; None: the pixels that the Gaussians cover.
    """
    if not prepared.reference.of_views:
        return None
    every, shown = RESULT_EVERY if covered is None else INPUT_EVERY, prepared.result_views()
    return _score_photos("score", written(gaussians, plan), shown, prepared, plan, covered, every)


def measure_input(prepared: Prepared, plan: Plan) -> PhotoScore | None:
    """Score the input's own Gaussians on the scored photos, and over the pixels that they cover; None without photos.

    If views have Gaussians of their own, the pixels that have one are covered.
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
    """Score Gaussians in the stage ``name`` on the scored photos, or on one of ``every`` so many of their tiles."""
    with stage(name):
        near, every, photos = NEAR_PLANE * prepared.frame.unit, every if plan.samples else 1, scene_photos(views)
        return score_photos(gaussians, photos, plan.scored_views, every=every, near=near, covered=covered)


def _measure_covered(before: PhotoScore | None, gaussians: Gaussians, prepared: Prepared, plan: Plan) -> Covered | None:
    """Score a result over the pixels that the input covers; ``before`` is the score of the input.

    None if the input covers all pixels, or if photos count only where the input covers them anyway.
    """
    if before is None or covers_all(before) or prepared.scene.empty is not None:
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
    """Score the input's own Gaussians; the score on the scored views is the plan's if the plan has it."""
    photos, gaussians = plan.before or measure_input(prepared, plan), prepared.input_scene.file_gaussians
    return InputScores(
        photos, _measure_on_files(gaussians, prepared, plan), _measure_protected(gaussians, prepared, plan)
    )


@dataclass(frozen=True)
class PartScores:
    """PSNR of input and result on parts of the pixels, and on unchanged photos; None where that says nothing more.

    The names are those of :class:`gsmerge.compaction.report.CompactReport`.
    """

    covered: Covered | None = None
    photo_files: PhotoFiles | None = None
    protected: Covered | None = None


def measure_parts(before: InputScores, gaussians: Gaussians, prepared: Prepared, plan: Plan) -> PartScores:
    """Score a result over covered and over protected pixels, and on photos as their files have them.

    ``before`` are the scores of the input.
    """
    covered, rounded = _measure_covered(before.photos, gaussians, prepared, plan), written(gaussians, plan)
    after = None if before.on_files is None else _measure_on_files(rounded, prepared, plan)
    files = None if before.on_files is None or after is None else PhotoFiles(before.on_files, after)
    within = None if before.protected is None else _measure_protected(rounded, prepared, plan)
    protected = within and before.protected and (within.share, before.protected.covered_psnr, within.covered_psnr)
    return PartScores(covered, files, Covered(*protected) if protected else None)
