"""``gsmerge evaluate``: a scene and its compact versions against photos."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, one_line, say, say_notes, stage_progress
from gsmerge.cli.held_out import file_names, held_out_views, networks, require_views
from gsmerge.cli.paths import check_outputs, input_files
from gsmerge.cli.settings import reading_of, told_as_usage
from gsmerge.errors import UsageError

if TYPE_CHECKING:
    from gsmerge.io import PlyInfo
    from gsmerge.measure.evaluate import EvaluateOptions, Evaluation, Views
    from gsmerge.types import Gaussians, PixelScene, UnalignedScene


def evaluate(
    scene: opt.SceneArgument,
    results: Annotated[
        list[Path] | None, typer.Argument(metavar="[RESULTS]...", help="Compact .ply files of that scene.")
    ] = None,
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
    views: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Take so many of the input views, at equal intervals, as the context, and the held-out ones midway"
            " between them as targets.",
            show_default="all",
            rich_help_panel=opt.MEASURING,
        ),
    ] = None,
    lpips: opt.LpipsOption = None,
    lpips_views: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Measure it on at most so many views of each split.",
            show_default="all",
            rich_help_panel=opt.MEASURING,
        ),
    ] = None,
    context: Annotated[
        bool,
        typer.Option("--context/--no-context", help="Also measure the input views.", rich_help_panel=opt.MEASURING),
    ] = True,
    csv: Annotated[
        Path | None, typer.Option(help="Write a row for each result and view here.", rich_help_panel=opt.OUTPUT)
    ] = None,
    report: opt.ReportOption = None,
    threads: opt.ThreadsOption = None,
    overwrite: opt.OverwriteOption = False,
    json: opt.JsonOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Measure compact scenes against photos: PSNR, SSIM, LPIPS, counts, sizes, render time."""
    hints = reading_of(exporter, quats.value, order.value, scene_scale, max_side)
    if not context and targets is None:
        raise UsageError("--no-context: expected held-out views to measure instead; name them with --targets")
    from gsmerge.io import find_scene_files, load_files, read_ply
    from gsmerge.measure.evaluate import EvaluateOptions

    files = find_scene_files(scene, cameras=cameras, images=images)
    paths = results or []
    check_outputs((csv, report), (*input_files(files), *paths, targets, target_images), overwrite=overwrite)
    nets, missing = networks(lpips)
    with told_as_usage():
        options = EvaluateOptions(nets, lpips_views, context, threads=threads)
    load = load_files(files, opacity=opacity.value, hints=hints)
    require_views(load)
    measured, held_out, adapted = held_out_views(load, targets, target_images, views)
    plys = {name: read_ply(path) for name, path in zip(file_names(paths), paths, strict=True)}
    notes = [*load.notes, *adapted, *missing]
    say_notes(notes, quiet=quiet or json)
    gaussians = {name: ply.gaussians for name, ply in plys.items()}
    found = _measure(measured, held_out, gaussians, options, quiet=quiet or json)
    facts = {"input": _file(load.ply), **{name: _file(ply.info) for name, ply in plys.items()}}
    _tell(found, facts, notes, csv, report, as_json=json, quiet=quiet, overwrite=overwrite)


def _file(info: PlyInfo) -> dict[str, Any]:
    return {"path": info.path, "bytes": info.file_bytes, "bytes_by_attribute": info.bytes_by_attribute}


def _measure(
    scene: PixelScene | UnalignedScene,
    held_out: Views | None,
    gaussians: dict[str, Gaussians],
    options: EvaluateOptions,
    *,
    quiet: bool,
) -> Evaluation:
    from gsmerge.measure.evaluate import evaluate as evaluate_scene

    with announce_compilation(quiet=quiet), stage_progress(quiet=quiet) as progress:
        return evaluate_scene(scene, gaussians, held_out, options, progress=progress)


def _tell(
    found: Evaluation,
    facts: dict[str, dict[str, Any]],
    notes: Sequence[str],
    csv: Path | None,
    report: Path | None,
    *,
    as_json: bool,
    quiet: bool,
    overwrite: bool,
) -> None:
    """The figures where they were asked for: files, stdout, or a table."""
    from gsmerge.io import atomic_output
    from gsmerge.measure.scores import evaluation_csv, evaluation_document, evaluation_lines
    from gsmerge.report import to_json

    document = evaluation_document(found, facts, notes)
    for path, text in ((report, to_json(document)), (csv, evaluation_csv(document))):
        if path is not None:
            with atomic_output(path, overwrite=overwrite) as temporary:
                temporary.write_text(text, encoding="utf-8", errors="replace")
    if as_json:
        sys.stdout.write(to_json(document))
    elif not quiet:
        print("\n".join(map(one_line, evaluation_lines(document))))
        for note in found.notes:
            say(f"note: {note}")
