"""Compact a scene in memory: in one piece, or in blocks of views.

In one piece, a result is built once if its number of Gaussians is known, otherwise several times until a quality is
met.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from os import PathLike
from typing import Any
from weakref import ref

import numpy as np

from gsmerge.compaction.candidate import Candidate, make_candidate
from gsmerge.compaction.costs import measure_costs
from gsmerge.compaction.file_size import meet_bytes
from gsmerge.compaction.methods import Method, choose_method
from gsmerge.compaction.new_views import try_new_views
from gsmerge.compaction.result import CompactResult, make_result
from gsmerge.compaction.search import CountSearch, add_target, build_left_out, search_count
from gsmerge.errors import Doubt, DoubtWarning, TargetError
from gsmerge.facts.counts import level_counts
from gsmerge.facts.crop import crop_scene
from gsmerge.facts.prepare import Prepared
from gsmerge.facts.scene_size import measure_size
from gsmerge.fit import Fitted
from gsmerge.pipeline import Build
from gsmerge.plan import Plan, choose_blocks, choose_for_scene, make_plan
from gsmerge.runtime.record import (
    Progress,
    Record,
    add_seconds,
    adopt,
    begin_part,
    expect_parts,
    note,
    record_choices,
    record_part,
    record_run,
)
from gsmerge.runtime.threads import use_threads
from gsmerge.scene.input import as_scene
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.stages import CleanOptions
from gsmerge.types import Gaussians, Scene, StrPath
from gsmerge.values.arguments import check_arguments

# If a result is clearly worse than its input, the scene is compacted again with these changes of the options, one after
# another, until a result is not clearly worse. A note in the report quotes the words
SIMPLER: Sequence[tuple[str, Callable[[CompactOptions], CompactOptions]]] = (
    ("with the scene's own colours in place of the photos", lambda o: o.with_settings({"look": "scene"})),
    ("without a fit", lambda o: o.with_settings({"fit": "none"})),
    ("with more Gaussians", lambda o: replace(o, budget=replace(o.budget, keep=True))),
)
SURPLUS = 1.05  # Gaussians that are built, relative to the number that has to remain after clean-up


@check_arguments
def compact(
    scene: Scene | StrPath, options: CompactOptions | None = None, *, progress: Progress | None = None, **settings: Any
) -> CompactResult:
    """Replace a scene by a compact one that renders at least as well from new viewpoints.

    Args:
        scene: What :func:`gsmerge.read_scene` returns, or a path that it can read. A scene of tensors gives a result of
            tensors.
        options: Settings of all stages; None: the defaults.
        progress: Called with (stage, done, stages); long stages also call ``progress`` with ("fit: ...", step, steps).
        **settings: Single settings by name that override ``options``: ``compact(scene, k=2, superpixels="1%")``.

    Raises:
        SceneError: If a path cannot be read, or a scene has values of another convention, such as log scales.
        ValueError: If a setting is unknown or out of range.
        TargetError: If no result is as good as the input, and no setting decides the number of Gaussians.

    Doubts about the result are warnings of the class :class:`gsmerge.DoubtWarning`. Notes go to the logger ``gsmerge``.

    Example:
        >>> result = gsmerge.compact("demo", effort="draft", budget=400)
        >>> len(result.gaussians)
        400
    """
    options = (options or CompactOptions()).with_settings(settings)
    with use_threads(options.threads), record_run(progress):
        result = compact_scene(as_scene(scene), options)
    if isinstance(scene, str | PathLike):
        result = replace(result, scene=scene)
    for text in filter(None, [*result.report.doubts, result.report.unmet]):
        warnings.warn(text, DoubtWarning, stacklevel=3)  # the caller: above this function and its decorator
    return result


def compact_scene(scene: Scene, options: CompactOptions) -> CompactResult:
    """Replace a scene by a compact one as :func:`compact` does, within a run that the caller records.

    Nothing is checked, and doubts are in the report instead of Python warnings.
    """
    source = ref(scene)  # a weak reference, so that the result does not keep the scene in memory
    if options.clean.crop is not None:
        scene = crop_scene(scene.numpy(), options.clean.crop)
    result = _compact_once(scene, options)
    if result.report.is_far and options.scene_decides:
        result = _compact_simpler(scene, options, result)
    if isinstance(scene.gaussians.means, np.ndarray) and scene.gaussians.means.dtype == np.float32:
        result = result.to_single()
    return replace(result, scene=source, names=scene.names)


def _compact_simpler(scene: Scene, options: CompactOptions, result: CompactResult) -> CompactResult:
    """Compact a scene again with the changes of ``SIMPLER``, until a result is not clearly worse than its input.

    ``result`` is the first result, which is clearly worse than the input. A note says what was changed. Raises
    TargetError if all results are clearly worse than the input.
    """
    cause = result.report.worse
    for words, change in SIMPLER:
        simpler = change(options)
        if simpler == options:  # the first result was made with these options
            continue
        with record_part():
            note(Doubt(f"{cause}; so it was made again {words}"))
            result = _compact_once(scene, simpler)
        if not result.report.is_far:
            return result
    problem, budget = f"expected a result as good as its input, found none: {cause}", max(1, len(result.gaussians))
    raise TargetError(
        f"{problem}; gsmerge inspect says how it is read, and --budget {budget} writes a result all the same"
    )


def _compact_once(scene: Scene, options: CompactOptions) -> CompactResult:
    """Compact a scene: in blocks if the views are cut into several blocks, otherwise in one piece."""
    size, budget = measure_size(scene), options.budget
    if budget.number is not None and budget.number > size.num_gaussians:
        note(f"budget {budget.budget}: the input has only {size.num_gaussians:,} Gaussians, so the result has no more")
    num_blocks = choose_blocks(size, options)
    if num_blocks > 1:
        from gsmerge.compaction.blocks import compact_in_blocks, cut_views

        blocks, covisibility = cut_views(scene, options, num_blocks)
        if len(blocks) > 1:
            return compact_in_blocks(scene, options, choose_for_scene(size, options), blocks, covisibility)
    method = choose_method(options, scene)  # our own, or that of another package
    prepared = method.prepare(scene.numpy(), options.prepare)  # adds the frame, corrected photos and poses
    return compact_in_one_piece(prepared, method, options).to(scene.gaussians.device)


def compact_in_one_piece(prepared: Prepared, method: Method, options: CompactOptions) -> CompactResult:
    """Compact a prepared scene with a method, in one piece.

    A search finds the number of Gaussians, unless the options state it, and builds the result. Then coarser levels are
    built, a trial measures what new views gain, and the input is scored for the report.
    """
    plan = add_target(make_plan(prepared, options), prepared)  # from here on, the plan replaces the options
    costs = measure_costs(prepared, plan)
    expect_parts(costs.all_parts(plan.limits, plan.limits.default))
    search = search_count(prepared, plan, method.build)
    best = run_search(search, method.build, prepared)
    best = meet_bytes(best, partial(build_again, method.build, prepared, plan), prepared, plan)
    num_best = len(best.gaussians)
    coarser_counts = level_counts(num_best, plan.levels, plan.limits.min_count)
    expect_parts(costs.end_parts(num_best, coarser_counts))
    # coarser levels keep the cameras that the result has
    level_start = prepared.with_cameras(best.fitted.cameras), plan.with_fixed_cameras()
    levels = [build_candidate(method.build, *level_start, count) for count in coarser_counts]
    trial = try_new_views(prepared, plan, method.build, num_best)
    begin_part()  # the last part, which scores the input
    return make_result(best, levels, prepared, plan, search.facts(best), trial)


def run_search(search: CountSearch, build: Build, prepared: Prepared) -> Candidate:
    """Run a search for the number of Gaussians; return the best candidate, built from all views and cleaned up."""
    plan = search.plan
    if search.left_out is not None:  # candidates lack the left-out views, so the best count is built again
        search.run(partial(build_left_out, build, search.left_out, search.left_out.plan(plan)))
        return build_again(build, prepared, plan, search.count)
    if plan.keeps_fidelity and plan.clean.asked:  # what clean-up leaves out would count as errors in the search
        search.run(partial(build_candidate, build, prepared, replace(plan, clean=CleanOptions())))
        return clean_best(search.best, prepared, plan)
    search.run(partial(build_candidate, build, prepared, plan))
    return search.best


def find_count(scene: Scene, options: CompactOptions) -> int:
    """Return the number of Gaussians that a run would give a scene without cameras, if a PSNR decides this number.

    Estimates find the number by the same search as runs.
    """
    with use_threads(options.threads), record_part(silent=True):
        method = choose_method(options, scene)
        prepared = method.prepare(scene.numpy(), options.prepare)
        plan = add_target(make_plan(prepared, options), prepared)
        best = run_search(search_count(prepared, plan, method.build), method.build, prepared)
    return len(best.gaussians)


@record_part()
def build_candidate(build: Build, prepared: Prepared, plan: Plan, count: int | None) -> Candidate:
    """Build ``count`` Gaussians with a method, clean them up as the plan says, and score them."""
    begin_part()
    return make_candidate(count, build_cleaned(build, prepared, plan, count), prepared, plan)


def build_again(build: Build, prepared: Prepared, plan: Plan, count: int | None) -> Candidate:
    """Build a candidate after the search, and add its seconds to the seconds of the run."""
    candidate = build_candidate(build, prepared, plan, count)
    add_seconds(candidate.record.seconds)
    return candidate


@record_part()
def clean_best(candidate: Candidate, prepared: Prepared, plan: Plan) -> Candidate:
    """Clean up and score again the best candidate of a search that skipped clean-up."""
    adopt(candidate.record)
    gaussians, dropped = _clean_fitted(candidate.fitted, prepared, plan)
    _record_dropped(dropped, len(gaussians), None, prepared)
    return make_candidate(None, replace(candidate.fitted, gaussians=gaussians), prepared, plan)


def build_cleaned(build: Build, prepared: Prepared, plan: Plan, count: int | None) -> Fitted:
    """Build Gaussians and clean them up, so that ``count`` Gaussians remain if the scene has so many.

    A few more than ``count`` are built. If too few Gaussians remain after clean-up, all are built once more, with a
    surplus as large as the number that clean-up dropped. If too many Gaussians remain, the faintest are dropped.
    """
    if not plan.clean.asked:
        return build(prepared, plan, count)
    from gsmerge.stages.clean import faintest_dropped

    def build_once(built_count: int | None) -> tuple[Fitted, dict[str, int], Record]:
        """Build and clean up once; return what remains, the number of dropped Gaussians by reason, and the record."""
        with record_part() as record:
            fitted = build(prepared, plan, built_count)
            gaussians, dropped = _clean_fitted(fitted, prepared, plan)
        add_seconds(record.seconds)
        return replace(fitted, gaussians=gaussians), dropped, record

    max_count = len(prepared.scene.gaussians)
    first_count = None if count is None else min(max_count, math.ceil(SURPLUS * count))
    fitted, dropped, record = build_once(first_count)
    if count is not None and first_count is not None and len(fitted.gaussians) < count and first_count < max_count:
        factor = SURPLUS * count / max(1, len(fitted.gaussians))
        fitted, dropped, record = build_once(min(max_count, math.ceil(factor * first_count)))
    gaussians = fitted.gaussians
    if count is not None and len(gaussians) > count:
        gaussians, dropped = faintest_dropped(gaussians, count), dropped | {"surplus": len(gaussians) - count}
    adopt(record)
    _record_dropped(dropped, len(gaussians), count, prepared)
    return replace(fitted, gaussians=gaussians)


def _clean_fitted(fitted: Fitted, prepared: Prepared, plan: Plan) -> tuple[Gaussians, dict[str, int]]:
    """Clean up fitted Gaussians; return the remaining Gaussians, and the number of dropped Gaussians by reason."""
    from gsmerge.stages.clean import clean

    # Cameras that were placed for scores are too few to show all of the scene. If `clean` gets no cameras, it places
    # enough to show the whole scene
    cameras = None if prepared.reference.placed else fitted.cameras[sorted({*prepared.repeated})]
    rows, dropped = clean(fitted.gaussians, plan.clean, cameras, prepared.scene.images, prepared.frame.leave)
    return fitted.gaussians[rows], dropped


def _record_dropped(dropped: dict[str, int], remaining: int, count: int | None, prepared: Prepared) -> None:
    """Record the number of dropped Gaussians by reason, with notes, also if fewer than ``count`` remain."""
    from gsmerge.stages.clean import describe_counts

    record_choices(clean=dropped)
    # The input was cropped before the run. The crop below only removes Gaussians that the fit moved across the border,
    # usually none
    shown = {name: number for name, number in dropped.items() if number or name != "cropped"}
    if shown:
        note(f"left out by clean-up: {describe_counts(shown, placed=prepared.reference.placed)}")
    if dropped.get("sky"):
        note("PSNR of the input views counts the sky that was left out as errors")
    if count is not None and remaining < count:
        note(f"budget: {count:,} Gaussians were asked for, {remaining:,} remain after clean-up")
