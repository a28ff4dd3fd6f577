"""Scores of the input and of a result, as PSNR against photos or renders of the input."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from gsmerge.arrays import max_columns
from gsmerge.frozen import dataclass, replace
from gsmerge.io.formats.write import round_as_written
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.geometry.views import scored_views
from gsmerge.method.pipelines.plan import ScorePlan
from gsmerge.method.raster.photos import NEAR_PLANE, WHOLE_SHARE, PhotoScore, scene_photos, score_photos
from gsmerge.method.stages.prune import ROUNDING
from gsmerge.prepare.compare_photos import row_spacing
from gsmerge.results.report import Covered, PhotoFiles
from gsmerge.runtime.record import stage
from gsmerge.types import Gaussians, Scene

# The input is scored on one of INPUT_EVERY tiles of the photos. A result is scored on one of RESULT_EVERY tiles,
# because the far fewer Gaussians of a result are drawn faster (REPORT_VIEWS says how exact such samples are)
INPUT_EVERY = 10
RESULT_EVERY = 2


def compares_all_pixels(before: PhotoScore | None) -> bool:
    """Return whether results are compared with their input over all pixels, also those that the input does not cover.

    ``before`` is the score of the input. All pixels count if the input covers nearly all or none of them, or if the
    input has no score.
    """
    return before is None or before.share >= WHOLE_SHARE or not math.isfinite(before.covered_psnr)


def measure_renders(gaussians: Gaussians, prepared: Prepared, plan: ScorePlan) -> PhotoScore:
    """Score canonical Gaussians against renders of the input in the scored views."""
    return score_photos(gaussians, scene_photos(prepared.scene), plan.views, covered=plan.covered)


def may_leave_gaps(prepared: Prepared, plan: ScorePlan) -> bool:
    """Return whether the input may leave gaps, because more than a few pixels are black in its renders."""
    pictures = (prepared.scene.images[view] for view in plan.views)
    return bool(np.mean([(max_columns(picture) > ROUNDING).mean() for picture in pictures]) < WHOLE_SHARE)


def round_for_output(gaussians: Gaussians, plan: ScorePlan) -> Gaussians:
    """Round the values of Gaussians as the output file does; return the Gaussians unchanged if no file is written."""
    return round_as_written(plan.output, gaussians) if plan.output else gaussians


def measure_result(
    gaussians: Gaussians, prepared: Prepared, plan: ScorePlan, covered: Sequence[np.ndarray] | None = None
) -> PhotoScore | None:
    """Score Gaussians of the world, as the output file rounds them, on the scored photos; None without photos.

    ``covered`` has a mask ``[h,w]`` for each scored photo, over which ``covered_psnr`` is measured. With ``covered``,
    the sample has the same tiles as that of the input. None: over the pixels that the Gaussians themselves cover.
    """
    if not prepared.reference.of_views:
        return None
    every = RESULT_EVERY if covered is None else INPUT_EVERY
    views = prepared.result_views()
    return _score_photos(
        "score", round_for_output(gaussians, plan), views=views, prepared=prepared, plan=plan, covered=covered,
        every=every,
    )  # fmt: skip


def measure_input(prepared: Prepared, plan: ScorePlan) -> PhotoScore | None:
    """Score the Gaussians of the input on the scored photos, and over the pixels that they cover; None without photos.

    If each Gaussian comes from one view, the covered pixels are the pixels that have a Gaussian and, in photos larger
    than those that the model saw, the pixels around them.
    """
    if not prepared.reference.of_views:
        return None
    views = prepared.input_scene
    if prepared.scene.empty is not None:  # where a result may show nothing, the input is not scored either
        views = replace(views, masks=prepared.result_views().masks)
    covered = None
    if views.covered is not None:
        covered = list(views.covered[list(plan.views)])
        spacing = row_spacing(views.covered)
        if spacing > 1:
            cell = np.ones((spacing, spacing), np.uint8)
            covered = [cv2.dilate(mask.astype(np.uint8), cell) > 0 for mask in covered]
    return _score_photos("input", views.file_gaussians, views=views, prepared=prepared, plan=plan, covered=covered)


def _score_photos(
    name: str,
    gaussians: Gaussians,
    views: Scene,
    prepared: Prepared,
    plan: ScorePlan,
    covered: Sequence[np.ndarray] | None,
    every: int = INPUT_EVERY,
) -> PhotoScore:
    """Score Gaussians of the world on the scored photos of ``views``, as the stage ``name``.

    If the plan allows samples, only one of ``every`` tiles of the photos counts.
    """
    with stage(name):
        near = NEAR_PLANE * prepared.frame.unit
        every = every if plan.samples else 1
        photos = scene_photos(views)
        return score_photos(gaussians, photos, plan.views, every=every, near=near, covered=covered)


def _measure_on_files(gaussians: Gaussians, prepared: Prepared, plan: ScorePlan) -> float | None:
    """Return the PSNR (dB) of Gaussians of the world on the photos as they are in their files.

    None if the run changed no scored photo.
    """
    photos = prepared.reference.photo_files
    if photos is None:
        return None
    views = prepared.result_views()
    if views.images is None or all(np.array_equal(views.images[view], photos[view]) for view in plan.views):
        return None
    return _score_photos(
        "score", gaussians, views=replace(views, images=photos), prepared=prepared, plan=plan, covered=None
    ).psnr


def _measure_protected(gaussians: Gaussians, prepared: Prepared) -> PhotoScore | None:
    """Score Gaussians of the world over the protected pixels, in views that have some; None if no view has any.

    ``share`` of the score is the share of protected pixels in all photos.
    """
    if not prepared.reference.of_views or prepared.input_scene.protected is None:
        return None
    with stage("score"):
        views = prepared.result_views()
        assert views.protected is not None
        protected_ids = np.flatnonzero(views.protected.any((1, 2))).tolist()
        ids = [protected_ids[i] for i in scored_views(len(protected_ids))]
        near = NEAR_PLANE * prepared.frame.unit
        masks = list(views.protected[ids])
        score = score_photos(gaussians, scene_photos(views), ids, near=near, covered=masks)
        return replace(score, share=float(views.protected.mean()))


@dataclass(frozen=True)
class InputScores:
    """Scores of an input, for comparison with a result; a score is None if it cannot be measured."""

    photos: PhotoScore | None  # On the scored photos
    on_files: float | None  # PSNR (dB) on the photos as they are in their files, if the run changed some
    protected: PhotoScore | None  # Over protected pixels


def score_input(prepared: Prepared, plan: ScorePlan) -> InputScores:
    """Score the Gaussians of the input. The plan may already have the score on the scored photos."""
    photos = plan.before or measure_input(prepared, plan)
    gaussians = prepared.input_scene.file_gaussians
    return InputScores(photos, _measure_on_files(gaussians, prepared, plan), _measure_protected(gaussians, prepared))


@dataclass(frozen=True)
class PartScores:
    """PSNR of input and result over parts of the pixels, and on photos before the run changed them.

    None for a part without pixels, or without changed photos. The names are those of
    :class:`gsmerge.results.report.CompactReport`.
    """

    covered: Covered | None = None
    photo_files: PhotoFiles | None = None
    protected: Covered | None = None


def measure_parts(before: InputScores, gaussians: Gaussians, prepared: Prepared, plan: ScorePlan) -> PartScores:
    """Score a result over covered and over protected pixels, and on the photos as they are in their files.

    ``before`` has the scores of the input, which are returned together with the scores of the result.
    """
    parts = PartScores()
    photos = before.photos
    # The covered pixels have no score of their own if the input covers nearly all pixels, or if the masks of the photos
    # leave out all uncovered pixels anyway
    if photos is not None and not compares_all_pixels(photos) and prepared.scene.empty is None:
        covered = measure_result(gaussians, prepared, plan, photos.covered)
        if covered is not None:
            parts = PartScores(Covered(photos.share, photos.covered_psnr, covered.covered_psnr))
    rounded = round_for_output(gaussians, plan)
    if before.on_files is not None and (after := _measure_on_files(rounded, prepared, plan)) is not None:
        parts = replace(parts, photo_files=PhotoFiles(before.on_files, after))
    if before.protected is not None and (score := _measure_protected(rounded, prepared)) is not None:
        parts = replace(parts, protected=Covered(score.share, before.protected.covered_psnr, score.covered_psnr))
    return parts
