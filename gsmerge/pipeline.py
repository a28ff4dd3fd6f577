"""The whole story: scene -> groups -> feature gaussians -> merged -> decoded -> fitted, and how many of them.

Another method than our own only takes the place of the stages: reading, frame, scores and report stay the same.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch

from gsmerge.baselines import Baseline, check_scene, find_baseline, unused_notes
from gsmerge.build import Source, build, keep_all
from gsmerge.errors import UsageError
from gsmerge.moments import scene_members
from gsmerge.networks import find_checkpoint
from gsmerge.options import CompactOptions
from gsmerge.render import composite, plan_view, prepare
from gsmerge.render.metrics import psnr
from gsmerge.render.photos import Photos, scene_photos
from gsmerge.runtime.memory import peak_memory
from gsmerge.runtime.run_log import STAGES, Progress, RunLog
from gsmerge.runtime.threads import parallel_map, use_threads
from gsmerge.search import (
    AUTO_RUNGS,
    LONG,
    MOST,
    RUNGS,
    SHORT,
    count_within,
    curve_knee,
    level_counts,
    measure_curve,
    rungs,
    search_count,
)
from gsmerge.stages.assign import ContributionOptions
from gsmerge.stages.group import Canvas, Grouping, cut_scene, group_scene, knee_count, scene_canvas, scene_tree
from gsmerge.stages.prepare import NEAR, Frame
from gsmerge.stages.region_tree import RegionTree
from gsmerge.stages.unaligned import make_ready
from gsmerge.types import Gaussians, PixelScene, UnalignedScene
from gsmerge.views import judged_views

ONE_AT_A_TIME = 400_000  # Gaussians; the plan of a view is as large as they are, so threads share one view instead
AUTO_STEPS = 2  # times the usual ones


@dataclass(frozen=True)
class CompactReport:
    """What a run did.

    Args:
        num_input: Gaussians in the scene.
        num_output: Gaussians in the result.
        seconds: Wall time of each stage.
        psnr_before: Mean PSNR (dB) of the input views, of many some, rendered from the input; None without photos.
        psnr_after: The same from the result.
        choices: What the stages decided (count, curve, merge, scores, clusters, fit).
        notes: Things worth telling, one sentence each.
        options: All settings by flat name.
        peak_memory_bytes: Largest resident memory of the process so far.
        unmet: Why a target that was asked for is not met, and how far the result got; None if it is.
    """

    num_input: int
    num_output: int
    seconds: dict[str, float]
    psnr_before: float | None
    psnr_after: float | None
    choices: dict[str, Any]
    notes: list[str]
    options: dict[str, Any]
    peak_memory_bytes: int
    unmet: str | None = None


@dataclass(frozen=True)
class CompactResult:
    """The compact Gaussians, in the scene's own world frame, and the report.

    Args:
        gaussians: The Gaussians.
        report: What was done.
        coarser: Further levels of detail, each with a quarter of the Gaussians of the one before.
    """

    gaussians: Gaussians
    report: CompactReport
    coarser: tuple[CompactResult, ...] = ()


@dataclass(frozen=True, eq=False)
class Work:
    """A run under way: the scene as given, what Gaussians are built from, and what is known of their number.

    ``kept`` are Gaussians that are in no view, merged already; ``settings`` are what was asked for, of which
    ``options`` are what is left without those.
    """

    scene: PixelScene | UnalignedScene
    frame: Frame
    source: Source
    options: CompactOptions
    canvas: Canvas
    tree: RegionTree | None
    kept: Gaussians | None
    settings: CompactOptions
    baseline: Baseline | None


def compact(
    scene: PixelScene | UnalignedScene,
    options: CompactOptions | None = None,
    *,
    progress: Progress | None = None,
    **settings: Any,
) -> CompactResult:
    """Replace a scene by a compact one that renders at least as well from new viewpoints.

    Args:
        scene: One Gaussian per pixel and view, see :func:`gsmerge.read_scene`; or Gaussians in no order, which are
            given to the superpixels by what they add to the views.
        options: Settings of all stages; None: the defaults.
        progress: Called with (stage, done, total) as each stage begins, done and total in stages, and from within
            the longer ones with ("fit: ...", step, steps).
        **settings: Single settings by name, on top of ``options``: ``compact(scene, k=2, density=0.01)``.

    Returns:
        The Gaussians and a report; further levels of detail if they were asked for.

    Raises:
        ValueError: If a setting is unknown or out of range, or asks for what the scene does not have.
    """
    options = _settled((options or CompactOptions()).with_settings(settings))
    log = RunLog(progress)
    with use_threads(options.threads), torch.no_grad():
        work = begin(scene, options, log)
        if options.target.target_psnr is not None:
            result = _searched(work, options.target.target_psnr, log)
        else:
            result = _built(work, decide(work, log), log)
        counts = level_counts(len(result.gaussians), options.target.levels, work.canvas.least)
        results = [result, *(_built(work, count, RunLog(progress)) for count in counts)]
        near = NEAR * work.frame.unit
        del work
        if scene.images is not None:  # last, when the kernels are there and the rest is gone
            ending = RunLog(progress)
            with ending.stage("input"):
                before = input_psnr(scene.file_gaussians, scene_photos(scene), near)
            results = [_compared(one, before, ending.seconds if i == 0 else {}) for i, one in enumerate(results)]
    if progress:
        progress("done", len(STAGES), len(STAGES))
    return replace(results[0], coarser=tuple(results[1:]))


def _compared(result: CompactResult, before: float, seconds: dict[str, float]) -> CompactResult:
    """A result that knows how good the input was, and the seconds that it took to find out."""
    report, peak = result.report, peak_memory()
    return replace(
        result, report=replace(report, psnr_before=before, seconds=report.seconds | seconds, peak_memory_bytes=peak)
    )


def _settled(options: CompactOptions) -> CompactOptions:
    """With ``k="auto"``, twice the steps unless told: fewer Gaussians cost less each, and need them for fine detail."""
    if options.decode.k != "auto" or options.fit.fit_steps is not None:
        return options
    return replace(options, fit=replace(options.fit, fit_steps=AUTO_STEPS * options.fit.steps))


def begin(
    scene: PixelScene | UnalignedScene, settings: CompactOptions, log: RunLog, frame: Frame | None = None
) -> Work:
    """The scene in its own frame, or a given one, and its superpixels if they are to be cut to a number."""
    target, baseline = settings.target, _rival(scene, settings, log)
    if baseline is not None:  # nothing is set aside, and nothing is learned
        settings = replace(settings, contribution=ContributionOptions(), checkpoint="none", require_checkpoint=False)
    if scene.images is None and target.searches:
        raise UsageError("a quality target needs photos, and the scene has none; give --images, or a --budget")
    with log.stage("prepare"):
        ready = make_ready(scene, settings, frame)
        canonical, frame, options = ready.scene, ready.frame, ready.options
        known = isinstance(canonical, PixelScene) or options.checkpoint != "auto"  # they learnt from one per pixel
        name = options.networks(photos=scene.images is not None) if known else "none"
        checkpoint, notes = find_checkpoint(name, required=options.require_checkpoint)
        log.notes += [*ready.notes, *notes, *_judged_note(scene)]
        canvas = scene_canvas(canonical, options)
    members = scene_members(canonical) if isinstance(canonical, PixelScene) else None
    source = Source(canonical, members, checkpoint)
    plain = not target.searches and options.decode.k != "auto" and canvas.limit is None
    tree = None
    if baseline is None and (not plain or target.levels > 1):
        with log.stage("segment"):
            tree = scene_tree(canonical, canvas, options, canvas.exact or canvas.usual)
    return Work(scene, frame, source, options, canvas, tree, ready.kept, settings, baseline)


def _judged_note(scene: PixelScene | UnalignedScene) -> list[str]:
    """A note where not all views are scored."""
    if scene.images is None or len(judged_views(len(scene))) == len(scene):
        return []
    return [f"the input views are scored on {len(judged_views(len(scene)))} of {len(scene)}"]


def _rival(scene: PixelScene | UnalignedScene, settings: CompactOptions, log: RunLog) -> Baseline | None:
    """The rival method that was asked for, fit for the scene; what it does not look at is told."""
    baseline = find_baseline(settings.method)
    if baseline is not None:
        check_scene(baseline, scene)
        log.notes += unused_notes(baseline, settings)
    return baseline


def decide(work: Work, log: RunLog) -> int | None:
    """The number of Gaussians, as the options and the scene's own curve have it; None: as density and K say."""
    canvas, options, drop = work.canvas, work.options, work.options.target.max_drop
    if drop is None and options.decode.k != "auto":
        return canvas.limit
    assert work.tree is not None
    if work.scene.images is None:
        return knee_count(work.tree, canvas, options)
    with log.stage("curve"):
        counts = rungs(AUTO_RUNGS if drop is None else RUNGS, canvas.usual, canvas.least, canvas.most)
        steps = SHORT if drop is None else LONG
        points = measure_curve(replace(work.source, checkpoint=None), canvas, work.tree, options, steps, counts, log)
    count = curve_knee(points) if drop is None else count_within(points, drop)
    log.choices["curve"] = [asdict(point) for point in points]
    return count


def _searched(work: Work, target: float, log: RunLog) -> CompactResult:
    """The fewest Gaussians that render the input photos at a PSNR; the best that was reached where none do."""
    results: dict[int, CompactResult] = {}

    def run(count: int) -> float:
        own = RunLog(log.progress)
        results[count] = _built(work, count, own)
        return results[count].report.psnr_after or 0.0

    most = min(work.canvas.most, MOST * work.canvas.usual)
    search = search_count(run, target, min(work.canvas.usual, most), work.canvas.least, most)
    result = results[search.count]
    seconds = log.seconds | {
        name: sum(r.report.seconds.get(name, 0.0) for r in results.values()) + log.seconds.get(name, 0.0)
        for name in result.report.seconds
    }
    unmet = None
    if not search.met:
        unmet = (
            f"target psnr: {target:g} dB was asked for, the input views reach {search.psnr:.2f} dB"
            f" with {len(result.gaussians)} Gaussians"
        )
    choices = result.report.choices | {"search": asdict(search)}
    notes = [*log.notes, *result.report.notes]
    return replace(result, report=replace(result.report, choices=choices, seconds=seconds, notes=notes, unmet=unmet))


def _built(work: Work, count: int | None, log: RunLog) -> CompactResult:
    """One result: cut to a number of Gaussians, or as density and K say, built or made by a rival method, scored."""
    options, canvas = work.options, work.canvas
    if work.baseline is not None:
        gaussians = work.baseline.run(work.source, canvas, options, canvas.usual if count is None else count, log)
    elif keeps_all(work, count):
        assert isinstance(work.source.scene, UnalignedScene)
        gaussians = keep_all(work.source.scene, options, log)
    else:
        gaussians = build(work.source, choose_groups(work, count, log), options, log)
    gaussians = work.frame.leave(gaussians if work.kept is None else Gaussians.concat([gaussians, work.kept]))
    after = None
    if work.scene.images is not None:
        with log.stage("score"):
            after = input_psnr(gaussians, scene_photos(work.scene), NEAR * work.frame.unit)
    counts = work.scene.num_gaussians, len(gaussians)
    settings = work.settings.to_dict() | {"fit_steps": options.fit.steps}
    report = CompactReport(*counts, log.seconds, None, after, log.choices, log.notes, settings, peak_memory())
    return CompactResult(gaussians, report)


def keeps_all(work: Work, count: int | None) -> bool:
    """Whether so many Gaussians are asked for that a scene in no order need not be grouped."""
    scene = work.source.scene
    return count is not None and isinstance(scene, UnalignedScene) and count >= len(scene.gaussians)


def choose_groups(work: Work, count: int | None, log: RunLog) -> Grouping:
    """Superpixels cut to a number of Gaussians, or as density and K say."""
    with log.stage("segment"):
        if count is None:
            return group_scene(work.canvas, work.options)
        assert work.tree is not None
        return cut_scene(work.source.scene, work.canvas, work.tree, work.options, count)


def input_psnr(gaussians: Gaussians, photos: Photos, near: float) -> float:
    """Mean PSNR (dB) of the photos, of many some, rendered from some Gaussians beyond the near plane."""
    splats, views = prepare(gaussians), judged_views(len(photos))

    def one_view(view: int) -> float:
        plan = plan_view(splats, **photos.camera(view), near=near)
        return psnr(np.clip(composite(plan)[0], 0, 1), photos.images[view])

    if len(gaussians) > ONE_AT_A_TIME:
        return float(np.mean([one_view(view) for view in views]))
    return float(np.mean(parallel_map(one_view, views)))


__all__ = ["CompactOptions", "CompactReport", "CompactResult", "compact"]
