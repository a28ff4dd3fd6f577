"""A run, from its first function to its last: read -> prepare -> plan -> build -> score -> write.

:func:`compact_files` reads and writes, :func:`compact_scene` crops and repeats, :func:`plan_run` prepares and plans,
and :func:`compact_prepared` builds and scores. A plain run goes through these functions from top to bottom.
:func:`gsmerge.method.pipelines.build.build` calls the stages in their order. Every other run, such as a search for the
number of Gaussians, is one call behind an ``if``; its module calls ``build`` as often as it needs, but for blocks,
which are merged apart and fitted together.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from time import perf_counter
from typing import TYPE_CHECKING, Any

from gsmerge.errors import Doubt, DoubtWarning, SceneError, TargetError
from gsmerge.io import atomic_outputs
from gsmerge.io.formats.rows import result_comments
from gsmerge.io.formats.table import Contents
from gsmerge.method.facts.pictures import RENDERS
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.facts.scene_size import measure_size
from gsmerge.method.pipelines.build import build, make_pipeline
from gsmerge.method.pipelines.plan import Plan
from gsmerge.plan.blocks import choose_blocks
from gsmerge.plan.forecast import run_parts
from gsmerge.plan.make_plan import is_without_views, make_plan, note_ignored
from gsmerge.prepare.crop import crop_scene
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.prepare.steps import STEPS, without
from gsmerge.reading.exporters import NO_HINTS, ReadHints
from gsmerge.reading.file_stats import doubt_changed
from gsmerge.reading.input import as_scene, read_input
from gsmerge.reading.read_scene import Loaded
from gsmerge.reading.scene_files import SceneFiles, scene_title
from gsmerge.results.candidate import Candidate, make_candidate
from gsmerge.results.lost_values import format_notes
from gsmerge.results.outputs import (
    Outputs,
    add_outputs,
    frame_notes,
    list_first_layers,
    refuse_to_replace_cameras,
    settings_for,
)
from gsmerge.results.report import report_document
from gsmerge.results.result import CompactResult, make_result
from gsmerge.runtime.arguments import check_arguments
from gsmerge.runtime.record import Progress, begin_part, expect_parts, note, record_part, record_run
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.compact import OURS, CompactOptions
from gsmerge.settings.reading import OpacityChoice
from gsmerge.types import Gaussians, Scene, StrPath

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from gsmerge.settings.keywords import CompactSettings

# If a result is clearly worse than its input, the scene is compacted again with these changes of the options, one after
# another, until a result is not clearly worse. A note in the report quotes the words
SIMPLER: Sequence[tuple[str, Callable[[CompactOptions], CompactOptions]]] = (
    ("with the scene's own colours in place of the photos", lambda o: o.with_settings({"look": "scene"})),
    ("without a fit", lambda o: o.with_settings({"fit": "none"})),
    ("with more Gaussians", lambda o: replace(o, budget=replace(o.budget, keep=True))),
)


@check_arguments
def compact(
    scene: Scene | Gaussians | StrPath, options: CompactOptions | None = None, *, progress: Progress | None = None,
    **settings: Unpack[CompactSettings],
) -> CompactResult:  # fmt: skip
    """Replace a scene by a compact one that renders at least as well from new viewpoints.

    Args:
        scene: What :func:`gsmerge.read_scene` returns, or a path that it can read. A scene of tensors gives a result of
            tensors. Gaussians alone are compacted as a file without cameras.
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


def compact_files(
    files: SceneFiles,
    settings: CompactOptions,
    outputs: Outputs,
    *,
    opacity: OpacityChoice = "auto",
    hints: ReadHints = NO_HINTS,
    progress: Progress | None = None,
    hashed: bool = False,
    seconds_before: Mapping[str, float] | None = None,
    on_read: Callable[[Loaded], None] = lambda _: None,
) -> dict[str, Any]:
    """Read a scene, compact it, and write result, levels and cameras: all files or none.

    If ``hashed``, the report has hashes of the input files. ``seconds_before`` has the wall time of the caller's
    earlier steps, by name. ``on_read`` is called with the scene after it was read.

    Returns the report, see :func:`gsmerge.results.report.report_document`. Raises SceneError if the scene cannot be
    read or the result cannot be written, and UsageError if the scene lacks something that the settings need.
    """
    start = perf_counter()
    settings = settings_for(outputs, settings)
    out = outputs.result
    format_ = outputs.format
    with atomic_outputs(overwrite=outputs.overwrite) as add:
        temporary = add(out)  # before the long work, so that an output that cannot be written ends the run at once
        load = read_input(files, opacity=opacity, hints=hints, hashed=hashed)
        on_read(load)
        views = list_first_layers(load.scene)
        names = [load.scene.names[view] for view in views]
        cameras_path = outputs.viewer_cameras if views else None
        if cameras_path is not None and cameras_path.exists() and not outputs.overwrite:  # fail before the long work
            refuse_to_replace_cameras(cameras_path, load.scene.cameras[views], names, moved=True)
        read_at = perf_counter()
        with use_threads(settings.threads), record_run(progress):
            result = compact_scene(load.scene, settings)
        if len(result.gaussians) == 0:
            problem = "expected Gaussians that show something, found none that remains after merging"
            raise SceneError(files.ply, problem, "check its scales and opacities")
        result = result.pad_to_full() if outputs.options.columns == "full" else result
        compacted_at = perf_counter()
        levels = [level.gaussians for level in (result, *result.coarser)]
        cameras = result.cameras[views]
        comments = result_comments(result.report.new_views, load.comments)
        contents = Contents(levels, comments, cameras, names, scene_title(files.ply))
        level_files = add_outputs(add, outputs, temporary, contents)
        _, *coarser_files = level_files  # the first level is the result itself
        notes = [*format_notes(out, result.gaussians, cameras), *frame_notes(outputs, cameras)]
        document = report_document(
            result.report, recognised=load.recognised, output_path=out,
            seconds_before={**(seconds_before or {}), "read": read_at - start},
            seconds_after={"write": perf_counter() - compacted_at},
            coarser=[(path, level.report) for path, level in zip(coarser_files, result.coarser, strict=True)],
            notes=[*load.notes, *notes, *doubt_changed(load.stats)], written_at=level_files, cameras_path=cameras_path,
        )  # fmt: skip
    format_.finish(out)
    return document


def compact_scene(scene: Scene, options: CompactOptions) -> CompactResult:
    """Replace a scene by a compact one as :func:`compact` does, within a run that the caller records.

    Nothing is checked, and doubts are in the report instead of Python warnings.
    """
    whole = scene
    budget = options.budget
    if options.clean.crop is not None:
        scene = crop_scene(scene.numpy(), options.clean.crop)
    size = measure_size(scene)
    if budget.number is not None and budget.number > size.num_gaussians:
        note(f"budget {budget.budget}: the input has only {size.num_gaussians:,} Gaussians, so the result has no more")
    num_blocks = choose_blocks(size, options)
    if num_blocks > 1:
        from gsmerge.blocks.compact_blocks import compact_in_blocks

        result = compact_in_blocks(scene, options, size, num_blocks)
        if result is not None:  # the views are worth several blocks
            return result.for_scene(whole)
    result = compact_prepared(*plan_run(scene, options))
    if result.report.is_far and options.scene_decides:
        result = compact_simpler(scene, options, result)
    return result.for_scene(whole)


def plan_run(scene: Scene, options: CompactOptions) -> tuple[Prepared, Plan]:
    """Prepare a scene, and plan its run."""
    if options.method != OURS:
        from gsmerge.plan.methods import choose_method

        method = choose_method(options, scene)
        prepared = method.prepare(scene.numpy(), options.prepare)
        return prepared, make_plan(prepared, options, pipeline=make_pipeline(method.name, method.run))
    note_ignored(scene, options)
    steps = without("pixels") if is_without_views(scene, options) else STEPS
    prepared = prepare(scene.numpy(), options.prepare, steps=steps)
    return prepared, make_plan(prepared, options)


def compact_prepared(prepared: Prepared, plan: Plan) -> CompactResult:
    """Build the Gaussians of a prepared scene as the plan says, in one piece, and score them."""
    if plan.count.keeps_fidelity or prepared.reference.name == RENDERS:
        from gsmerge.counts.search import add_target

        plan = add_target(plan, prepared)
    expect_parts(run_parts(prepared, plan))
    levels = list[Candidate]()
    if plan.searches:
        from gsmerge.counts.search import search_count

        best = search_count(prepared, plan)
    else:
        begin_part("build")
        best = make_candidate(build(prepared, plan, plan.count.limits.count), prepared, plan)
    if plan.count.levels > 1:
        from gsmerge.counts.search import build_levels

        levels = build_levels(best, prepared, plan)
    begin_part("input")
    result = make_result(best, levels, prepared, plan)
    if plan.score.new_views:
        from gsmerge.results.new_views import expect_new_views

        result = replace(result, report=expect_new_views(result.report, prepared, plan))
    return result


def compact_simpler(scene: Scene, options: CompactOptions, result: CompactResult) -> CompactResult:
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
            result = compact_prepared(*plan_run(scene, simpler))
        if not result.report.is_far:
            return result
    problem = f"expected a result as good as its input, found none: {cause}"
    budget = max(1, len(result.gaussians))
    raise TargetError(
        f"{problem}; gsmerge inspect says how it is read, and --budget {budget} writes a result all the same"
    )
