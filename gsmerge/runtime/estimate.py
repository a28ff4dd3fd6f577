"""What a run will take, in seconds and bytes, from a scene's number of pixels and the settings."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gsmerge.runtime.memory import human_bytes, machine_memory

MAX_SCORED_VIEWS = 24  # views that whole scenes are scored by

# Time. Only right within a factor of two: measured on 12 and on 84 views of 480 pixels, with compiled kernels.
IMPORT_SECONDS = 1.5
# Processor seconds per million pixels of all views together, or per million Gaussians, which is the same number:
COST_READ = 0.7
COST_SEGMENT = {"rdseg": 0.5, "bass": 1.5, "bass-st": 1.5, "bass-adaptive": 6.0, "slic": 4.5, "grid": 0.0}
COST_MERGE = 0.5
COST_NETWORKS = 2.8  # at the default superpixels
COST_SCORE = 0.07  # for each scored view: rendering from input and output
COST_ROBUST = 1.6
COST_COLOR_FIT = 0.9
COST_FIT_RENDERS = 1.5  # what the full fit renders of all views besides its steps
COST_BASELINES = {"moment-matching": 1.7, "voxel": 1.8, "contribution": 0.7, "greedy": 25.0, "splat-transform": 60.0}
COST_OTHER_BASELINE = 0.2
COST_UNMERGED_STEP = 0.15  # for each step of the full fit of an input that was not merged
# Processor seconds per step of the full fit and million pixels of one view:
COST_FULL_FIT = 0.2

# Memory, in bytes.
BYTES_FIXED = 450_000_000  # interpreter, torch and numba
BYTES_PER_GAUSSIAN = 150
BYTES_PER_VALUE = 4.5  # of higher harmonics, per Gaussian: those of the scene, and of some of its groups
BYTES_PER_PIXEL = 90  # the photo as floats and what segmentation and rendering hold of it


def work_seconds(pixels: int, view_pixels: float, options: Mapping[str, Any], *, photos: bool, fit_steps: int) -> float:
    """Processor seconds that a scene takes, without imports, within a factor of about two.

    Args:
        pixels: Of all views together, or Gaussians where they are more.
        view_pixels: Of one view.
        options: All settings by flat name, with the checkpoint that is used.
        photos: Whether the scene has photos.
        fit_steps: Steps of the full fit.
    """
    method, fit, views = options["method"], fit_of(options, photos=photos), pixels / max(view_pixels, 1)
    if method == "gsmerge":
        work = COST_MERGE + COST_SEGMENT[options["segmentation"]] + COST_ROBUST * is_robust(options, photos=photos)
        work += COST_NETWORKS * (options["checkpoint"] != "none")
    else:
        work = COST_BASELINES.get(method, COST_OTHER_BASELINE)
    work += COST_READ + score_cost(views) * photos
    work += COST_COLOR_FIT * (fit == "color") + COST_FIT_RENDERS * (fit == "full")
    steps = fit_steps if fit == "full" else 0
    seconds = pixels / 1e6 * work + view_pixels / 1e6 * COST_FULL_FIT * steps
    return seconds + pixels / 1e6 * COST_UNMERGED_STEP * steps * (method == "unmerged-fit")


def score_cost(views: float) -> float:
    """Processor seconds per million pixels for scoring input and result: every Gaussian in every scored view."""
    return COST_SCORE * min(views, MAX_SCORED_VIEWS)


def memory_bytes(pixels: int, *, photos: bool, num_rest: int = 0) -> int:
    """Memory that a scene takes, imports included, within a factor of about two.

    Args:
        pixels: As of :func:`work_seconds`.
        photos: Whether the scene has photos.
        num_rest: Columns of higher harmonics.
    """
    return BYTES_FIXED + round((BYTES_PER_GAUSSIAN + BYTES_PER_VALUE * num_rest + BYTES_PER_PIXEL * photos) * pixels)


def memory_problem(needed: int, available: int | None) -> str | None:
    """A sentence where a scene is not likely to fit into the machine's memory; None where it does.

    Args:
        needed: Bytes, by :func:`memory_bytes`.
        available: Bytes that the machine has; None: not known.
    """
    if available is None or needed <= available:
        return None
    return (
        f"about {needed / 1e9:.1f} GB of memory are needed and this machine has {available / 1e9:.1f} GB: use fewer"
        " views (gsmerge extend adds more later), export without higher harmonics, or try --effort draft"
    )


def fit_of(options: Mapping[str, Any], *, photos: bool) -> str:
    """What is fitted to the photos: full, color or none."""
    own = {"gsmerge": options["fit"], "unmerged-fit": "full", "unmerged-color": "color"}
    return own.get(options["method"], "none") if photos else "none"


def is_robust(options: Mapping[str, Any], *, photos: bool) -> bool:
    """Whether the photos choose among merges."""
    return photos and options["method"] == "gsmerge" and bool(options["robust"])


def estimate_run(
    grid: tuple[int, int, int],
    options: Mapping[str, Any],
    num_pixels: int,
    *,
    photos: bool,
    threads: int,
    fit_steps: int,
    num_rest: int = 0,
) -> dict[str, Any]:
    """Seconds and bytes of a run, right within a factor of about two once the kernels are compiled.

    Args:
        grid: Views, height and width.
        options: All settings by flat name, as of ``CompactOptions.resolved()``.
        num_pixels: Of all views together, or Gaussians where they are more.
        photos: Whether the scene has photos.
        threads: Threads that run.
        fit_steps: Steps of the full fit.
        num_rest: Columns of higher harmonics.

    Returns:
        ``seconds``, ``memory_bytes``, and ``machine_memory_bytes``, None where the system does not report it.
    """
    views, height, width = grid
    seconds = work_seconds(num_pixels, height * width, options, photos=photos, fit_steps=fit_steps)
    return {
        "seconds": round(IMPORT_SECONDS + seconds / max(1, min(threads, views)), 1),
        "memory_bytes": memory_bytes(num_pixels, photos=photos, num_rest=num_rest),
        "machine_memory_bytes": machine_memory(),
    }


def plan_document(
    files: Mapping[str, str | None],
    grid: tuple[int, int, int],
    options: Mapping[str, Any],
    *,
    output_path: Path,
    per_view: int,
    photos: bool,
    threads: int,
    fit_steps: int,
    default_count: int,
    budget: int | None = None,
    notes: Sequence[str] = (),
    count: int | None = None,
    num_rest: int = 0,
) -> dict[str, Any]:
    """What a run would make of a scene, and an estimate of its time and memory, as plain JSON types.

    Args:
        files: Paths of the ``ply``, the ``cameras`` and the ``images``.
        grid: Views, height and width of the Gaussian grid.
        options: All settings by flat name, as of ``CompactOptions.resolved()``.
        output_path: The ``.ply`` that would be written.
        per_view: Superpixels per view; a budget distributes them differently.
        photos: Whether the scene has photos; robust merging and the fit need them.
        threads: Threads that would run.
        fit_steps: Steps of the full fit.
        default_count: Most Gaussians that superpixels and K give.
        budget: Gaussians that a budget, a file size or a preset asks for; None without any.
        notes: Of the reader.
        count: Gaussians of the file; None: one for each pixel of the grid.
        num_rest: Columns of higher harmonics.

    Returns:
        The plan, without the head of a document; ``estimate`` is as of :func:`estimate_run`.
    """
    views, height, width = grid
    pixels = max(views * height * width, count or 0)
    method = options["method"]
    max_count = default_count if budget is None else budget
    max_count = pixels if method.startswith("unmerged") else max_count
    return {
        "dry_run": True,
        "input": {**files, "num_gaussians": count or pixels, "num_views": views, "height": height, "width": width},
        "output": {"path": os.fspath(output_path), "num_gaussians_at_most": min(count or pixels, max_count)},
        "method": method,
        "superpixels_per_view": per_view if budget is None and options["budget"] != "auto" else None,
        "robust": is_robust(options, photos=photos),
        "fit": fit_of(options, photos=photos),
        "estimate": estimate_run(
            grid, options, pixels, photos=photos, threads=threads, fit_steps=fit_steps, num_rest=num_rest
        ),
        "options": dict(options),
        "notes": list(notes),
    }


def memory_problems(estimate: Mapping[str, Any]) -> list[str]:
    """That an estimated run is not likely to fit into this machine's memory; nothing where it does."""
    problem = memory_problem(estimate["memory_bytes"], estimate["machine_memory_bytes"])
    return [] if problem is None else [problem]


def plan_lines(plan: Mapping[str, Any]) -> list[str]:
    """The plan for people."""
    scene, estimate, per_view = plan["input"], plan["estimate"], plan["superpixels_per_view"]
    superpixels = "where the scene needs them"
    if per_view is not None:
        chosen = plan["options"]
        adapts = chosen["segmentation"] == "bass-adaptive" and not str(chosen["superpixels"]).isdecimal()
        start = " at the start" if adapts else ""
        superpixels = f"{per_view:,} per view{start}, {chosen['k']} Gaussian(s) each"
    steps = [
        f"superpixels  {superpixels}",
        f"merging      {'the best of a family, judged by the photos' if plan['robust'] else 'plain'},"
        f" across views: {plan['options']['match']}",
        f"networks     {plan['options']['checkpoint']}",
    ]
    return [
        f"would read   {scene['ply']}: {scene['num_views']} views of {scene['width']} x {scene['height']}",
        f"would write  {plan['output']['path']}: at most {plan['output']['num_gaussians_at_most']:,} Gaussians",
        *(steps if plan["method"] == "gsmerge" else [f"method       {plan['method']}"]),
        f"fit          {plan['fit']}",
        f"estimate     about {estimate['seconds']:.0f} s, {human_bytes(estimate['memory_bytes'])} of memory",
        *(f"memory       {problem}" for problem in memory_problems(estimate)),
        *(f"note         {note}" for note in plan["notes"]),
    ]
