"""The top: compact a scene in one piece or in blocks, for one count or for several until a quality is met."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from os import PathLike
from typing import TYPE_CHECKING
from weakref import ReferenceType, ref

import numpy as np

from gsmerge.arguments import check_arguments
from gsmerge.compaction.file_size import meet_bytes
from gsmerge.compaction.forecast import RunForecast
from gsmerge.compaction.make_plan import make_plan
from gsmerge.compaction.methods import Method, choose_method
from gsmerge.compaction.new_views import trial_part, try_new_views
from gsmerge.compaction.result import Candidate, CompactResult, make_result, score
from gsmerge.compaction.search import add_target, build_left_out, level_counts, meet, search_count
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
from gsmerge.scene.read import as_scene
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.stages import CleanOptions
from gsmerge.types import Gaussians, Scene, StrPath

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from gsmerge.settings.keywords import CompactKeywords

MAX_BUILDS, SURPLUS = 3, 1.05  # tries to meet a count after clean-up; more than it by so much at first


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
        scene: What :func:`gsmerge.read_scene` returns, or the path that it reads. Tensors give tensors.
        options: Settings of all stages; None: the defaults.
        progress: Called with (stage, done, stages), and from within longer ones with ("fit: ...", step, steps).
        **settings: Single settings by name, on top of ``options``: ``compact(scene, k=2, superpixels="1%")``.

    Raises:
        SceneError: If a path cannot be read.
        ValueError: If a setting is unknown or out of range.

    Doubts are warned of as :class:`gsmerge.DoubtWarning`, notes go to the logger ``gsmerge``.

    Example:
        >>> result = gsmerge.compact("demo", effort="draft", budget=400)
        >>> len(result.gaussians)
        400
    """
    options = (options or CompactOptions()).with_settings(settings)
    with use_threads(options.threads), record_run(progress):
        asked, scene = scene, as_scene(scene)
        given: StrPath | ReferenceType[Scene] = asked if isinstance(asked, str | PathLike) else ref(asked)
        del asked  # which may be freed
        if options.clean.crop is not None:
            scene = crop_scene(scene.numpy(), options.clean.crop)
        size = measure_size(scene)
        choices = choose_for_scene(size, options)  # what needs no work to decide
        note_engine(size, options, choices.blocks)
        note_surplus(size, options.budget)
        if choices.blocks > 1:
            from gsmerge.compaction.blocks import compact_in_blocks, cut_views

            blocks, covisibility = cut_views(scene, options, choices.blocks)
            if len(blocks) > 1:
                return _finish(compact_in_blocks(scene, options, choices, blocks, covisibility), scene, given)
        method = choose_method(options, scene)  # ours, that for scenes without cameras, or a baseline
        prepared = method.prepare(scene.numpy(), options.prepare)  # facts: frame, photos, poses, unseen
        return _finish(compact_prepared(prepared, method, options).to(scene.gaussians.device), scene, given)


def _finish(result: CompactResult, scene: Scene, given: StrPath | ReferenceType[Scene]) -> CompactResult:
    """Return a result with the precision of the scene's means, and warn of what makes it doubtful."""
    report, agreement = result.report, result.report.choices.get("agreement") or {}
    doubts = [report.worse, report.unmet, *(text for text in report.notes if text == agreement.get("doubt"))]
    for text in dict.fromkeys(filter(None, doubts)):
        warnings.warn(text, DoubtWarning, stacklevel=4)
    if isinstance(scene.gaussians.means, np.ndarray) and scene.gaussians.means.dtype == np.float32:
        result = result.to_single()
    return replace(result, scene=given, names=scene.names)


def compact_prepared(prepared: Prepared, method: Method, options: CompactOptions) -> CompactResult:
    """Compact a scene of which the facts are known."""
    plan = add_target(make_plan(prepared, options), prepared)  # options end here

    def rebuild(count: int | None) -> Candidate:
        candidate = build_scored(method.build, prepared, plan, count)
        add_seconds(candidate.record.seconds)  # beside those of the search
        return candidate

    forecast = RunForecast(prepared, plan, trial_part(prepared, plan))
    search = search_count(prepared, plan, method.build, forecast)  # one count, or counts until a quality is met
    if search.left_out is None:
        uncleaned = replace(plan, clean=CleanOptions()) if plan.cleans_last else plan
        search.run(partial(build_scored, method.build, prepared, uncleaned), forecast)
        best = clean_last(search.best, prepared, plan)
    else:
        search.run(partial(build_left_out, method.build, search.left_out, search.left_out.plan(plan)), forecast)
        forecast.expect_builds(search.count)
        best = rebuild(search.count)
    best = meet_bytes(best, rebuild, prepared, plan)
    fixed = prepared.with_cameras(best.fitted.cameras), plan.with_fixed_cameras()
    counts = level_counts(len(best.gaussians), plan)
    forecast.expect_end(counts)
    levels = [build_scored(method.build, *fixed, count) for count in counts]
    trial = try_new_views(prepared, plan, method.build, len(best.gaussians))
    begin_part()
    return make_result(best, levels, prepared, plan, search.facts(best), trial)


@record_part()
def build_scored(build: Build, prepared: Prepared, plan: Plan, count: int | None) -> Candidate:
    """Build ``count`` Gaussians with a method, clean them up as the plan says, and score them."""
    begin_part()
    return score(count, build_cleaned(build, prepared, plan, count), prepared, plan)


@record_part()
def clean_last(candidate: Candidate, prepared: Prepared, plan: Plan) -> Candidate:
    """Clean up a candidate that was searched for without, and score it again; any other stays as it is."""
    if not plan.cleans_last:
        return candidate
    adopt(candidate.record)
    gaussians, counts = _clean(candidate.fitted, prepared, plan)
    _note_clean(counts, len(gaussians), None, prepared)
    return score(None, replace(candidate.fitted, gaussians=gaussians), prepared, plan)


def build_cleaned(build: Build, prepared: Prepared, plan: Plan, count: int | None) -> Fitted:
    """Build Gaussians and clean them up so that exactly ``count`` remain, if the scene holds that many.

    More Gaussians are built than requested, and the faintest surplus ones are dropped.
    """
    options = plan.clean
    if not options.asked:
        return build(prepared, plan, count)
    from gsmerge.stages.clean import faintest_dropped

    most = len(prepared.scene.gaussians)

    def build_more(asked: int | None) -> tuple[int | None, Fitted, dict[str, int], Record]:
        with record_part() as record:
            fitted = build(prepared, plan, asked)
            gaussians, counts = _clean(fitted, prepared, plan)
        add_seconds(record.seconds)
        return asked, replace(fitted, gaussians=gaussians), counts, record

    def ask_for_more(built: Sequence[tuple[int | None, Fitted, dict[str, int], Record]]) -> int | None:
        asked, left = built[-1][0], len(built[-1][1].gaussians)
        if count is None or asked in (None, most) or left >= count or len(built) == MAX_BUILDS:
            return None
        return min(most, math.ceil(SURPLUS * asked * count / max(1, left)))

    first = None if count is None else min(most, math.ceil(SURPLUS * count))
    built = meet(build_more, build_more(first), ask_for_more)
    _, fitted, counts, record = max(built, key=lambda each: len(each[1].gaussians))
    gaussians = fitted.gaussians
    if count is not None and len(gaussians) > count:
        gaussians, counts = faintest_dropped(gaussians, count), counts | {"surplus": len(gaussians) - count}
    adopt(record)
    _note_clean(counts, len(gaussians), count, prepared)
    return replace(fitted, gaussians=gaussians)


def _clean(fitted: Fitted, prepared: Prepared, plan: Plan) -> tuple[Gaussians, dict[str, int]]:
    """Clean up fitted Gaussians as :func:`gsmerge.stages.clean.clean`."""
    from gsmerge.stages.clean import clean

    cameras = None if prepared.reference.placed else fitted.cameras  # placed ones judge a scene, and do not show it all
    rows, counts = clean(fitted.gaussians, plan.clean, cameras, prepared.scene.images, prepared.frame.leave)
    return fitted.gaussians[rows], counts


def _note_clean(counts: dict[str, int], left: int, count: int | None, prepared: Prepared) -> None:
    """Record what clean-up left out, and whether fewer than ``count`` are left."""
    from gsmerge.stages.clean import describe_counts

    choose(clean=counts)
    shown = {
        name: number for name, number in counts.items() if number or name != "cropped"
    }  # by the fit, over a border
    if shown:
        note(f"left out by clean-up: {describe_counts(shown, placed=prepared.reference.placed)}")
    if counts.get("sky"):
        note("PSNR of the input views counts what is left out as errors")
    if count is not None and left < count:
        note(f"budget: {count:,} Gaussians were asked for, {left:,} are left after clean-up")
