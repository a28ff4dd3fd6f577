"""``gsmerge stress``: a user's own scene under bad conditions."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, one_line, say_notes, stage_progress
from gsmerge.cli.held_out import held_out_views, require_views
from gsmerge.cli.paths import check_outputs, input_files
from gsmerge.cli.settings import reading_of, settings_of
from gsmerge.errors import TargetError

if TYPE_CHECKING:
    from gsmerge.research.stress import StressOutcome


def stress(
    scene: opt.SceneArgument,
    cameras: opt.CamerasOption = None,
    images: opt.ImagesOption = None,
    opacity: opt.OpacityOption = opt.Opacity.auto,
    exporter: opt.DialectOption = "auto",
    quats: opt.QuatsOption = opt.Quats.auto,
    order: opt.OrderOption = opt.Order.auto,
    scene_scale: opt.SceneScaleOption = None,
    max_side: opt.MaxSideOption = None,
    targets: opt.TargetsOption = None,
    target_images: opt.TargetImagesOption = None,
    cases: Annotated[
        str | None,
        typer.Option(metavar="NAME,...", help="Only these cases.", show_default="all", rich_help_panel=opt.MEASURING),
    ] = None,
    effort: opt.EffortOption = None,
    k: opt.KOption = None,
    density: opt.DensityOption = None,
    budget: opt.BudgetOption = None,
    fit: opt.FitOption = None,
    fit_steps: opt.FitStepsOption = None,
    seed: opt.SeedOption = None,
    threads: opt.ThreadsOption = None,
    report: opt.ReportOption = None,
    overwrite: opt.OverwriteOption = False,
    json: opt.JsonOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Compact a scene under bad conditions, and say of each whether the result is what it should be."""
    hints = reading_of(exporter, quats.value, order.value, scene_scale, max_side)
    from gsmerge.io import atomic_output, find_scene_files, load_files
    from gsmerge.options import to_schema
    from gsmerge.report import document_head, to_json
    from gsmerge.research.stress import stress as stress_scene

    files = find_scene_files(scene, cameras=cameras, images=images)
    check_outputs([report], (*input_files(files), targets, target_images), overwrite=overwrite)
    chosen = {"effort": effort, "k": k, "density": density, "budget": budget, "fit": fit, "fit_steps": fit_steps}
    settings = settings_of({**chosen, "seed": seed, "threads": threads})
    load = load_files(files, opacity=opacity.value, hints=hints)
    require_views(load)
    _, held_out, adapted = held_out_views(load, targets, target_images, None)
    notes = [*load.notes, *adapted]
    say_notes(notes, quiet=quiet or json)
    names = None if cases is None else [name.strip() for name in cases.split(",")]
    with announce_compilation(quiet=quiet or json), stage_progress(quiet=quiet or json) as progress:
        found = stress_scene(load, settings, targets=held_out, cases=names, hints=hints, progress=progress)
    document = {
        **document_head(),
        "input": str(files.ply),
        "options": to_schema(settings.to_dict()),
        "cases": [outcome.to_dict() for outcome in found],
        "held": sum(outcome.passed is True for outcome in found),
        "failed": sum(outcome.passed is False for outcome in found),
        "notes": notes,
    }
    if report is not None:
        with atomic_output(report, overwrite=overwrite) as temporary:
            temporary.write_text(to_json(document))
    if json:
        sys.stdout.write(to_json(document))
    elif not quiet:
        print("\n".join(map(one_line, _lines(found))))
    failed = [outcome.case for outcome in found if outcome.passed is False]
    if failed:
        raise TargetError(f"{len(failed)} of {len(found)} cases failed: {', '.join(failed)}")


def _lines(found: Sequence[StressOutcome]) -> list[str]:
    """One line for each case, and how many held."""
    marks = {True: "held", False: "FAILED", None: "-"}
    width = max((len(outcome.change) for outcome in found), default=0)
    lines = [f"{marks[o.passed]:<7} {o.change:<{width}}  {o.measured}" for o in found]
    lines += [f"        wanted of '{o.change}': {o.expected}" for o in found if o.passed is False]
    tried = [outcome for outcome in found if outcome.passed is not None]
    return [*lines, f"{sum(o.passed is True for o in tried)} of {len(tried)} held"]
