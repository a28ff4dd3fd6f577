"""The top: compact a scene in one piece or in blocks.

In one piece it is built once for one number of Gaussians, or several times until a quality is met.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from os import PathLike
from typing import TYPE_CHECKING
from weakref import ReferenceType, ref

import numpy as np

from gsmerge.arguments import check_arguments
from gsmerge.compaction.candidate import Candidate, score
from gsmerge.compaction.file_size import Rebuild, meet_bytes
from gsmerge.compaction.forecast import RunForecast
from gsmerge.compaction.make_plan import make_plan
from gsmerge.compaction.methods import Method, choose_method
from gsmerge.compaction.new_views import explain_no_trial, note_no_trial, trial_part, try_new_views
from gsmerge.compaction.report import CompactReport
from gsmerge.compaction.result import CompactResult, make_result
from gsmerge.compaction.search import CountSearch, add_target, build_left_out, level_counts, meet, search_count
from gsmerge.errors import DoubtWarning
from gsmerge.facts.crop import crop_scene
from gsmerge.facts.prepare import Prepared
from gsmerge.facts.scene_size import measure_size
from gsmerge.fit import Fitted
from gsmerge.pipeline import Build
from gsmerge.plan import Plan, choose_for_scene, note_engine, note_surplus
from gsmerge.runtime.record import (
    Progress,
    Record,
    add_seconds,
    adopt,
    begin_part,
    choose,
    note,
    record_part,
    record_run,
)
from gsmerge.runtime.threads import use_threads
from gsmerge.scene.input import as_scene
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.stages import CleanOptions
from gsmerge.types import Gaussians, Scene, StrPath

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from gsmerge.settings.keywords import CompactKeywords

# The requested count has to remain after clean-up. So the scene is built with SURPLUS times this count, at most
# MAX_BUILDS times
MAX_BUILDS, SURPLUS = 3, 1.05


@check_arguments
def compact(
    scene: Scene | StrPath,
    options: CompactOptions | None = None,
    *,
    progress: Progress | None = None,
    **settings: Unpack[CompactKeywords],
) -> CompactResult:
    """Replace a scene by a compact one that renders at least as well from new viewpoints.

    Args:
        scene: What :func:`gsmerge.read_scene` returns, or a path that it can read. A scene of tensors gives a result of
            tensors.
        options: Settings of all stages; None: the defaults.
        progress: Called with (stage, done, stages); long stages also call it with ("fit: ...", step, steps).
        **settings: Single settings by name that override ``options``: ``compact(scene, k=2, superpixels="1%")``.

    Raises:
        SceneError: If a path cannot be read, or a scene has values of another convention, such as log scales.
        ValueError: If a setting is unknown or out of range.

    Doubts about the result are warnings of the class :class:`gsmerge.DoubtWarning`. Notes go to the logger ``gsmerge``.

    Example:
        >>> result = gsmerge.compact("demo", effort="draft", budget=400)
        >>> len(result.gaussians)
        400
    """
    options = (options or CompactOptions()).with_settings(settings)
    with use_threads(options.threads), record_run(progress):
        # a reference, so that the result does not keep the scene in memory
        source: StrPath | ReferenceType[Scene] = scene if isinstance(scene, str | PathLike) else ref(scene)
        scene = as_scene(scene)
        if options.clean.crop is not None:
            scene = crop_scene(scene.numpy(), options.clean.crop)
        result = _compact_scene(scene, options)
        _warn_of_doubts(result.report)
        if isinstance(scene.gaussians.means, np.ndarray) and scene.gaussians.means.dtype == np.float32:
            result = result.to_single()
        return replace(result, scene=source, names=scene.names)


def _compact_scene(scene: Scene, options: CompactOptions) -> CompactResult:
    """Compact a scene: in blocks if its views are cut into several, otherwise in one piece."""
    size = measure_size(scene)
    choices = choose_for_scene(size, options)  # the decisions that need no computation
    note_engine(size, options, choices.blocks)
    note_surplus(size, options.budget)
    if choices.blocks > 1:
        from gsmerge.compaction.blocks import compact_in_blocks, cut_views

        blocks, covisibility = cut_views(scene, options, choices.blocks)
        if len(blocks) > 1:
            return compact_in_blocks(scene, options, choices, blocks, covisibility)
    method = choose_method(options, scene)  # ours, ours for scenes without cameras, or a baseline
    prepared = method.prepare(scene.numpy(), options.prepare)  # facts: frame, photos, poses, unseen
    return compact_prepared(prepared, method, options).to(scene.gaussians.device)


def _warn_of_doubts(report: CompactReport) -> None:
    """Warn the caller of :func:`compact` of everything that makes the result doubtful."""
    agreement = report.choices.get("agreement") or {}
    doubts = [report.worse, report.unmet, *(text for text in report.notes if text == agreement.get("doubt"))]
    for text in dict.fromkeys(filter(None, doubts)):
        warnings.warn(text, DoubtWarning, stacklevel=4)  # the caller: above this function, compact and its decorator


def compact_prepared(prepared: Prepared, method: Method, options: CompactOptions) -> CompactResult:
    """Compact a prepared scene with a method: plan, search, levels of detail, trial, result."""
    plan = make_plan(prepared, options)  # options end here
    plan = add_target(plan, prepared)

    def rebuild(count: int | None) -> Candidate:
        candidate = build_scored(method.build, prepared, plan, count)
        add_seconds(candidate.record.seconds)  # in addition to those of the search
        return candidate

    forecast = RunForecast(prepared, plan, trial_part(prepared, plan))
    search = search_count(prepared, plan, method.build, forecast)  # one count, or counts until a quality is met
    best = run_search(search, method.build, rebuild, prepared, forecast)
    best = meet_bytes(best, rebuild, prepared, plan)
    fixed = prepared.with_cameras(best.fitted.cameras), plan.with_fixed_cameras()
    counts = level_counts(len(best.gaussians), plan)
    forecast.expect_end(counts)
    levels = [build_scored(method.build, *fixed, count) for count in counts]
    trial = try_new_views(prepared, plan, method.build, len(best.gaussians))
    if options.new_views and trial is None:
        note_no_trial(explain_no_trial(prepared, len(best.gaussians)))
    begin_part()
    return make_result(best, levels, prepared, plan, search.facts(best), trial)


def run_search(
    search: CountSearch, build: Build, rebuild: Rebuild, prepared: Prepared, forecast: RunForecast
) -> Candidate:
    """Run a search for the number of Gaussians; return its best candidate, built from all views and cleaned up."""
    plan = search.plan
    if search.left_out is not None:  # its candidates lack views, so the best count is built again
        search.run(partial(build_left_out, build, search.left_out, search.left_out.plan(plan)), forecast)
        forecast.expect_builds(search.count)
        return rebuild(search.count)
    if plan.cleans_last:
        uncleaned = replace(plan, clean=CleanOptions())
        search.run(partial(build_scored, build, prepared, uncleaned), forecast)
        return clean_best(search.best, prepared, plan)
    search.run(partial(build_scored, build, prepared, plan), forecast)
    return search.best


@record_part()
def build_scored(build: Build, prepared: Prepared, plan: Plan, count: int | None) -> Candidate:
    """Build ``count`` Gaussians with a method, clean them up as the plan says, and score them."""
    begin_part()
    return score(count, build_cleaned(build, prepared, plan, count), prepared, plan)


@record_part()
def clean_best(candidate: Candidate, prepared: Prepared, plan: Plan) -> Candidate:
    """Clean up a candidate of a search without clean-up, and score it again."""
    adopt(candidate.record)
    gaussians, dropped = _clean(candidate.fitted, prepared, plan)
    _note_clean(dropped, len(gaussians), None, prepared)
    return score(None, replace(candidate.fitted, gaussians=gaussians), prepared, plan)


@dataclass(frozen=True, eq=False)
class CleanedBuild:
    """Gaussians that were built for a count and cleaned up."""

    count: int | None  # Gaussians that were built; None: as many as `superpixels` and K give
    fitted: Fitted  # The fit, with the Gaussians that remain after clean-up
    dropped: dict[str, int]  # Numbers of dropped Gaussians by reason
    record: Record  # Seconds, choices and notes


def build_cleaned(build: Build, prepared: Prepared, plan: Plan, count: int | None) -> Fitted:
    """Build Gaussians and clean them up, so that exactly ``count`` remain if the scene has that many.

    More Gaussians than ``count`` are built. Of those that remain after clean-up, the faintest surplus is dropped.
    """
    options = plan.clean
    if not options.asked:
        return build(prepared, plan, count)
    from gsmerge.stages.clean import faintest_dropped

    max_count = len(prepared.scene.gaussians)

    def build_once(built_count: int | None) -> CleanedBuild:
        with record_part() as record:
            fitted = build(prepared, plan, built_count)
            gaussians, dropped = _clean(fitted, prepared, plan)
        add_seconds(record.seconds)
        return CleanedBuild(built_count, replace(fitted, gaussians=gaussians), dropped, record)

    def choose_next(built: Sequence[CleanedBuild]) -> int | None:
        last_count, remaining = built[-1].count, len(built[-1].fitted.gaussians)
        if count is None or last_count in (None, max_count) or remaining >= count or len(built) == MAX_BUILDS:
            return None
        return min(max_count, math.ceil(SURPLUS * last_count * count / max(1, remaining)))

    first_count = None if count is None else min(max_count, math.ceil(SURPLUS * count))
    built = meet(build_once, build_once(first_count), choose_next)
    best = max(built, key=lambda cleaned: len(cleaned.fitted.gaussians))
    gaussians, dropped = best.fitted.gaussians, best.dropped
    if count is not None and len(gaussians) > count:
        gaussians, dropped = faintest_dropped(gaussians, count), dropped | {"surplus": len(gaussians) - count}
    adopt(best.record)
    _note_clean(dropped, len(gaussians), count, prepared)
    return replace(best.fitted, gaussians=gaussians)


def _clean(fitted: Fitted, prepared: Prepared, plan: Plan) -> tuple[Gaussians, dict[str, int]]:
    """Clean up fitted Gaussians; return the remaining Gaussians, and the number of dropped Gaussians by reason."""
    from gsmerge.stages.clean import clean

    # the few cameras placed for scores do not show all of the scene; without cameras, `clean` places more
    cameras = None if prepared.reference.placed else fitted.cameras
    rows, dropped = clean(fitted.gaussians, plan.clean, cameras, prepared.scene.images, prepared.frame.leave)
    return fitted.gaussians[rows], dropped


def _note_clean(dropped: dict[str, int], remaining: int, count: int | None, prepared: Prepared) -> None:
    """Note which Gaussians clean-up dropped, and whether fewer than ``count`` remain."""
    from gsmerge.stages.clean import describe_counts

    choose(clean=dropped)
    # the scene itself was cropped before: Gaussians count as cropped here if the fit moved them over the border
    shown = {name: number for name, number in dropped.items() if number or name != "cropped"}
    if shown:
        note(f"left out by clean-up: {describe_counts(shown, placed=prepared.reference.placed)}")
    if dropped.get("sky"):
        note("PSNR of the input views counts the sky that was left out as errors")
    if count is not None and remaining < count:
        note(f"budget: {count:,} Gaussians were asked for, {remaining:,} remain after clean-up")
