"""What ``--dry-run`` of compact and encode prints."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsmerge.cli.console import print_document
from gsmerge.cli.options import Args, usage_errors

if TYPE_CHECKING:
    from gsmerge.io import ReadHints, SceneFiles
    from gsmerge.options import CompactOptions
    from gsmerge.types import Scene


def print_plan(args: Args, files: SceneFiles, settings: CompactOptions, out: Path, hints: ReadHints) -> None:
    """Print what would be done, as lines or JSON."""
    from gsmerge.baselines import choose_baseline
    from gsmerge.compact_file import check_saved_cameras, read_input
    from gsmerge.gpu import choose_backend
    from gsmerge.report import document_head

    given = read_input(files, opacity=args.opacity, hints=hints)
    check_saved_cameras(given.scene, vars(args).get("save_cameras"))
    _, unused = choose_baseline(settings, given.scene)
    backend, problem = choose_backend(settings.device, given.scene.num_gaussians)
    settings = replace(settings, device=backend.device)
    problems = [] if problem is None else [problem]
    refused = os.path.lexists(out) and not args.overwrite
    exists = [f"{out} exists already: --overwrite would replace it"] * refused
    with usage_errors():
        document = plan_document(files, given.scene, settings, out, [*given.notes, *unused, *problems, *exists])
    print_document({**document_head(), **document}, plan_lines(document), as_json=args.json, wrap=True)


def plan_document(
    files: SceneFiles, scene: Scene, settings: CompactOptions, out: Path, notes: Sequence[str]
) -> dict[str, Any]:
    """What a run would make of a scene, and an estimate of its time and memory, as plain JSON types."""
    from gsmerge.plan import EFFORTS, resolve_fit, resolved_settings, steps_for
    from gsmerge.runtime.estimate import estimate_run, fit_of
    from gsmerge.runtime.threads import available_threads
    from gsmerge.stages.fit import photo_scale
    from gsmerge.stages.segment import count_limits, largest_count

    photos, grid = scene.images is not None, (len(scene), scene.cameras.height, scene.cameras.width)
    options = resolved_settings(settings, photos=photos)
    limits = count_limits(scene, settings.segment, settings.decode, settings.budget)
    pixels = max(len(scene) * scene.pixels_per_view, scene.num_gaussians)
    num_gaussians, fit = scene.num_gaussians or pixels, resolve_fit(settings)
    max_count = largest_count(limits, settings.segment)
    auto = EFFORTS[settings.effort].large_photos and settings.device == "cpu"
    if settings.method.startswith("unmerged"):
        max_count = pixels
    per_view = None  # a budget distributes them by what it needs
    if limits.count is None and options["budget"] != "auto":
        per_view = limits.per_view
    paths = {name: path and str(path) for name, path in vars(files).items()}
    return {
        "dry_run": True,
        "input": {
            **paths, "num_gaussians": num_gaussians, "num_views": grid[0], "height": grid[1], "width": grid[2],
        },
        "output": {"path": str(out), "num_gaussians_at_most": min(num_gaussians, max_count)},
        "method": settings.method,
        "superpixels_per_view": per_view,
        "fit": fit_of(options, photos=photos),
        "estimate": estimate_run(
            grid, options, pixels, photos=photos, threads=settings.threads or available_threads(),
            fit_steps=steps_for(settings, limits.count or limits.default, scene),
            num_rest=3 * scene.gaussians.shN.shape[1],
            photo_scale=photo_scale(scene, fit, auto=auto)[0],
        ),
        "options": options,
        "notes": list(notes),
    }  # fmt: skip


def plan_lines(plan: Mapping[str, Any]) -> list[str]:
    """The plan for people."""
    from gsmerge.report import human_bytes
    from gsmerge.runtime.estimate import memory_problems
    from gsmerge.stages.superpixels import SegmentOptions

    scene, estimate, per_view = plan["input"], plan["estimate"], plan["superpixels_per_view"]
    superpixels = "where the scene needs them"
    if per_view is not None:
        chosen = plan["options"]
        adapts = SegmentOptions(chosen["superpixels"], chosen["segmentation"]).adapts
        superpixels = f"{per_view:,} per view{' at the start' * adapts}, {chosen['k']} Gaussian(s) each"
    steps = [
        f"superpixels  {superpixels}",
        f"merging      across views: {plan['options']['match']}",
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
