"""Estimate the size, time and memory of a run without running it, as ``inspect`` and ``--dry-run`` show it."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from gsmerge.blocks.partition import gaussians_at_once
from gsmerge.counts.curve import curve_counts
from gsmerge.errors import count_words
from gsmerge.frozen import dataclass
from gsmerge.io.formats.ply import file_bytes
from gsmerge.io.formats.table import find_format
from gsmerge.method.facts.scene_size import measure_size
from gsmerge.method.geometry.frame import canonicalise
from gsmerge.method.pipelines.bare_rows import BARE_ROWS
from gsmerge.plan.blocks import choose_blocks
from gsmerge.plan.counts import FIDELITY_LOSS, FIDELITY_PSNR, level_counts, resolve_budget
from gsmerge.plan.forecast import TRIAL_SHARE, usual_builds
from gsmerge.plan.make_plan import is_without_views, note_ignored, plan_scene
from gsmerge.plan.methods import choose_method
from gsmerge.plan.networks import load_networks
from gsmerge.prepare.confirm_depths import confirm_depths
from gsmerge.prepare.crop import crop_scene
from gsmerge.prepare.prepare_scene import views_notes
from gsmerge.prepare.repeats import without_repeats
from gsmerge.reading.read_scene import Loaded
from gsmerge.results.outputs import Outputs
from gsmerge.runtime.documents import document_head, note_entries, note_lines
from gsmerge.runtime.memory import human_bytes, memory_bytes, memory_problem
from gsmerge.runtime.record import record_run
from gsmerge.runtime.threads import available_threads
from gsmerge.scoring.coverage import shares_inside
from gsmerge.settings.compact import OURS, CompactOptions
from gsmerge.types import Scene

INSIDE_GAUSSIANS = 10_000  # sample of Gaussians for the share that lies inside a view
BESIDE = ("cameras", "images", "masks", "protect")  # fields of SceneFiles that are read with the Gaussians
# Costs of runs: means over whole runs with various settings. Estimates are right within a factor of about two
IMPORT_SECONDS = 1.0  # imports, and the constant part of every run
# Seconds for each million pixels of all views together, or for each million Gaussians if there are more Gaussians than
# pixels:
COST_BUILD = 1.0  # superpixels, merging and scores of a result
COST_INPUT = 0.3  # reading and scoring the input
COST_NETWORKS = 1.4  # the shipped networks
COST_PAPER = 4.5  # the paper's networks, which have more inputs and refine
COST_PAIRS = 3.0  # merging neighbours pair by pair
COST_PLACED = 6.0  # drawing a scene without views from placed views
COST_SLOW = {"slic": 4.5, "greedy": 25.0, "splat-transform": 60.0}  # in addition, for slow methods
# Seconds for each step of the fit:
COST_STEP = 0.1  # per million pixels of its view
COST_DRAWN = 0.25  # per million Gaussians that it draws
THREAD_GAIN = 0.35  # speed of each thread after the first, relative to the first
PLACED_PIXELS = 1 << 18  # largest number of pixels of a placed view


@dataclass(frozen=True, eq=False)
class RunCosts:
    """Facts about a run that decide how many seconds it takes."""

    settings: Mapping[str, Any]  # All settings by flat name, with the networks in use
    num_pixels: int  # Pixels of all views together, or the number of Gaussians if it is larger
    view_pixels: float  # Pixels of one view
    inside: float  # Share of the result's Gaussians that a view draws
    steps: int  # Steps of a fit; 0 without a fit
    merges_pairs: bool = False  # Neighbours are merged pair by pair, instead of superpixels
    is_placed: bool = False  # The views are placed, since the scene has none
    num_builds: int = 1  # Results that are built until one has the quality that is asked for
    curve: tuple[Sequence[int], int] = ((), 0)  # Counts and steps of the short fits of the scene's curve
    has_trial: bool = False  # A trial estimates the quality of new views

    def build_seconds(self, count: float, steps: int) -> float:
        """Return the processor seconds to build ``count`` Gaussians with a fit of ``steps``."""
        settings = self.settings
        method = self.settings["method"]
        work = COST_PAIRS if self.merges_pairs else COST_BUILD
        work += COST_SLOW.get(settings["segmentation"] if method == OURS else method, 0.0)
        if method == OURS and settings["checkpoint"] != "none":
            work += COST_PAPER if "paper" in (settings["recipe"], settings["checkpoint"]) else COST_NETWORKS
        view_pixels = min(self.num_pixels, PLACED_PIXELS) if self.is_placed else self.view_pixels
        return (self.num_pixels * work + steps * (COST_STEP * view_pixels + COST_DRAWN * self.inside * count)) / 1e6

    def seconds(self, count: float, coarser: Iterable[float], num_views: int, threads: int) -> float:
        """Return the wall time of a run for ``count`` Gaussians, and for the ``coarser`` levels, with imports."""
        build = self.build_seconds(count, self.steps)
        curve_counts, curve_steps = self.curve
        work = build * (self.num_builds + TRIAL_SHARE * self.has_trial)
        work += sum(self.build_seconds(point_count, curve_steps) for point_count in curve_counts)
        work += sum(self.build_seconds(level_count, self.steps) for level_count in coarser)
        work += self.num_pixels * (COST_PLACED if self.is_placed else COST_INPUT) / 1e6
        return IMPORT_SECONDS + work / (1 + THREAD_GAIN * max(0, min(threads, num_views) - 1))


def estimate(scene: Scene, options: CompactOptions) -> dict[str, Any]:
    """Estimate size, time and memory of a run without running it.

    Returns:
        ``num_gaussians`` is the largest number of Gaussians that the result can have or, if ``exact``, the number that
        it will have. If ``psnr_kept`` is a number, ``num_gaussians`` is the smallest number, and the run takes
        more Gaussians, up to ``most_gaussians``, until the PSNR against the input is ``psnr_kept`` dB. If
        ``loss_kept`` is a number, the run takes more Gaussians only if otherwise the result shows the photos more than
        ``loss_kept`` dB worse than the input. If ``quality`` is given, the run takes more or fewer Gaussians
        until this quality is met. ``ratio`` is ``num_gaussians`` relative to the input, and ``bytes`` is the
        size as a ``.ply``. ``superpixels_per_view`` is None if a budget distributes superpixels among the
        views, and 0 if neighbouring Gaussians are merged instead of superpixels. ``blocks``, ``method``, ``k``,
        ``match``, ``checkpoint``, ``fit`` and ``fit_steps`` are the values that the run would use.
        ``seconds`` and ``memory_bytes`` have two digits, and are right within a factor of about two. ``memory_problem``
        says that this machine has too little memory, or is None.
    """
    if options.clean.crop is not None:
        scene = crop_scene(scene.numpy(), options.clean.crop)
    num_input, (scene, *_) = scene.num_gaussians, without_repeats(scene)
    size = measure_size(scene)
    if (options.budget.auto or options.budget.is_limit) and scene.has_own_pixels:
        options = resolve_budget(size, options, confirm_depths(canonicalise(scene)[0]))
    plan, num_blocks = plan_scene(size, options), choose_blocks(size, options)
    limits, settings = plan.count.limits, plan.settings
    num_pixels = max(limits.num_pixels, scene.num_gaussians)
    max_count = num_pixels if options.method.startswith("unmerged") else limits.count or limits.default
    if size.has_own_pixels and options.method == OURS and not (limits.count or plan.fit.grows):  # filled pixels count
        max_count = max(max_count, round(limits.per_view * size.num_views * plan.merge.decode.mean_k))
    no_views = is_without_views(scene, options)
    has_target = plan.count.keeps_fidelity or options.budget.target_psnr is not None
    count = min(scene.num_gaussians or num_pixels, max_count)
    keeps_renders = plan.count.keeps_fidelity and size.rendered
    # To search for the number would take as long as the run, so a plan knows its bounds alone; time is estimated for
    # their geometric mean
    most = limits.max_count if keeps_renders else count
    at_once, num_rest = gaussians_at_once(num_pixels, num_blocks), 3 * scene.gaussians.shN.shape[1]
    num_drawn = num_pixels if options.method == "unmerged-fit" else round(math.sqrt(count * most))
    fit = {OURS: plan.fit.fit, "unmerged-fit": "full"}.get(options.method, "none")
    steps = 0 if fit == "none" else plan.fit.steps
    all_pixels, budget = at_once * num_blocks, options.budget  # a view that is in two blocks is built twice
    # the mean over all views of the share of the scene's Gaussians that lies in the view
    inside = 1.0 if no_views else float(np.mean(shares_inside(scene, INSIDE_GAUSSIANS) or [1.0]))
    has_curve = (budget.auto or budget.max_drop is not None) and not (has_target or size.rendered)
    curve = curve_counts(budget.max_drop, limits.default, limits.min_count, limits.max_count) if has_curve else ([], 0)
    costs = RunCosts(
        settings=settings, num_pixels=all_pixels, view_pixels=all_pixels / max(1, len(scene)), inside=inside,
        steps=steps, merges_pairs=no_views, is_placed=no_views,
        num_builds=usual_builds(has_target=has_target, rendered=size.rendered), curve=curve,
        has_trial=steps > 0 and scene.has_own_pixels and options.new_views is not False,
    )  # fmt: skip
    coarser = level_counts(num_drawn, budget.levels, limits.min_count)
    seconds = costs.seconds(num_drawn, coarser, len(scene), options.threads or available_threads())
    memory = memory_bytes(at_once, num_rest=num_rest, num_elsewhere=num_pixels - at_once)
    per_view = None if limits.count is not None or budget.auto else limits.per_view
    if plan.pipeline == BARE_ROWS:
        per_view = 0
    return {
        "num_gaussians": count,
        "exact": options.budget.is_filled,
        "most_gaussians": most,
        "psnr_kept": FIDELITY_PSNR if keeps_renders else None,
        "quality": options.budget.quality,
        "loss_kept": FIDELITY_LOSS if plan.count.keeps_fidelity and not size.rendered else None,
        "ratio": count / max(1, num_input),
        "bytes": file_bytes(count, scene.gaussians.sh_degree),
        "blocks": num_blocks,
        "method": options.method,
        "superpixels_per_view": per_view,
        **{name: settings[name] for name in ("k", "match", "checkpoint")},
        "fit": fit,
        "fit_steps": plan.fit.steps,
        "seconds": float(f"{seconds:.2g}"),
        "memory_bytes": int(float(f"{memory:.2g}")),
        "memory_problem": memory_problem(memory),
    }


def estimate_lines(run: Mapping[str, Any]) -> list[str]:
    """Describe what :func:`estimate` returns in lines of text."""
    per_view = run["superpixels_per_view"]
    superpixels = "superpixels where the scene needs them"
    if per_view is not None:
        superpixels = f"{per_view:,} superpixels per view, {count_words(run['k'], 'Gaussian')} each"
    method = f"{superpixels}; merging across views: {run['match']}; networks: {run['checkpoint']}"
    if per_view == 0:
        method = "neighbours merged pair by pair, because no photo shows them"
    count = f"{run['num_gaussians']:,} Gaussians ({100 * run['ratio']:.1f} % of the input)"
    number = count if run["exact"] else f"at most {count}"
    if run["psnr_kept"] is not None:
        bound = f"at most {run['most_gaussians']:,} Gaussians; the run chooses the number"
        number = f"{bound}: {count}, or more until the PSNR against the input is {run['psnr_kept']:g} dB"
    if run["quality"] is not None:
        number = f"{count}, or more or fewer until --quality {run['quality']} is met"
    if run["loss_kept"] is not None:
        number = f"at most {count}, unless photos need more to be within {run['loss_kept']:g} dB of the input"
    return [
        f"compact    {number},"
        f" {human_bytes(run['bytes'])} as .ply, in about {run['seconds']:g} s with {run['memory_bytes'] / 1e9:g} GB of"
        " memory" + (f", in {run['blocks']} blocks" if run["blocks"] > 1 else ""),
        f"method     {method if run['method'] == 'gsmerge' else run['method']}; fit: {run['fit']}",
        *([f"memory     {run['memory_problem']}"] if run["memory_problem"] else []),
    ]


def estimate_files(load: Loaded, settings: CompactOptions, outputs: Outputs) -> dict[str, Any]:
    """Return the document of ``--dry-run``: what :func:`gsmerge.run.compact_files` would make."""
    scene = load.scene
    out = outputs.result
    notes = [*load.notes, *views_notes(scene)]
    if os.path.lexists(out) and not outputs.overwrite:
        notes.append(f"{out} exists already: --overwrite would replace it")
    with record_run() as record:
        note_ignored(scene, settings)
        if settings.method != OURS:
            choose_method(settings, scene)  # for its notes and errors
        elif settings.checkpoint != "auto":  # raises the errors of a named checkpoint
            load_networks(settings, measure_size(scene))
        run = estimate(scene, settings)
    paths = {name: path and str(path) for name, path in vars(load.files).items() if name in BESIDE}
    return {
        **document_head(),
        "dry_run": True,
        "input": load.recognised | paths,
        "output": {"path": str(out)},
        "compact": run,
        "options": settings.to_dict(),
        **note_entries([*notes, *record.notes]),
    }


def dry_run_lines(document: Mapping[str, Any]) -> list[str]:
    """Describe the document of :func:`estimate_files` in lines of text."""
    scene = document["input"]
    out = document["output"]["path"]
    number = scene["num_views"]
    size = f"{scene['width']} x {scene['height']}"
    inside = find_format(out).levels == "inside"
    levels = f", and {count_words(document['options']['levels'], 'level')} in chunks beside it" if inside else ""
    return [
        f"would read {scene['path']}: {f'{number} views of {size}' if number else 'no views'}",
        f"would write {out}{levels}",
        *estimate_lines(document["compact"]),
        *note_lines(document["notes"]),
    ]
