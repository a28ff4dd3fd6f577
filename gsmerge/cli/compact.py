"""``gsmerge compact``: the main job."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import typer

from gsmerge.cli import network_options as net
from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, one_line, say, say_notes, stage_progress
from gsmerge.cli.paths import check_format, check_output, default_output, input_files
from gsmerge.cli.settings import given_settings, reading_of, told_as_usage
from gsmerge.errors import TargetError

if TYPE_CHECKING:
    from gsmerge.io import ReadHints, SceneFiles
    from gsmerge.io.formats.ply import OpacityChoice
    from gsmerge.options import CompactOptions


def compact(
    context: typer.Context,
    scene: opt.SceneArgument,
    cameras: opt.CamerasOption = None,
    images: opt.ImagesOption = None,
    opacity: opt.OpacityOption = opt.Opacity.auto,
    exporter: opt.DialectOption = "auto",
    quats: opt.QuatsOption = opt.Quats.auto,
    order: opt.OrderOption = opt.Order.auto,
    scene_scale: opt.SceneScaleOption = None,
    max_side: opt.MaxSideOption = None,
    superpixels: opt.SuperpixelsOption = None,
    density: opt.DensityOption = None,
    segmentation: opt.SegmentationOption = None,
    effort: opt.EffortOption = None,
    k: opt.KOption = None,
    budget: opt.BudgetOption = None,
    max_bytes: opt.MaxBytesOption = None,
    preset: opt.PresetOption = None,
    max_drop: opt.MaxDropOption = None,
    target_psnr: opt.TargetPsnrOption = None,
    levels: opt.LevelsOption = None,
    robust: opt.RobustOption = None,
    match: opt.MatchOption = None,
    geometry: net.GeometryOption = None,
    fit: opt.FitOption = None,
    device: opt.DeviceOption = None,
    fit_steps: opt.FitStepsOption = None,
    time_budget: opt.TimeBudgetOption = None,
    unseen: opt.UnseenOption = None,
    method: opt.MethodOption = None,
    checkpoint: net.CheckpointOption = None,
    require_checkpoint: net.RequireCheckpointOption = False,
    output: opt.OutputOption = None,
    seed: opt.SeedOption = None,
    threads: opt.ThreadsOption = None,
    overwrite: opt.OverwriteOption = False,
    report: opt.ReportOption = None,
    json: opt.JsonOption = False,
    dry_run: opt.DryRunOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Write a compact scene that renders like the given one, or better, with 1 to 10 % of its Gaussians."""
    start = perf_counter()
    hints = reading_of(exporter, quats.value, order.value, scene_scale, max_side)
    from gsmerge.compact_file import level_output
    from gsmerge.io import find_scene_files

    files = find_scene_files(scene, cameras=cameras, images=images)
    out = output or default_output(files.ply)
    inputs = (*input_files(files), *net.checkpoint_files(checkpoint))
    outputs = [out, *(level_output(out, level) for level in range(1, levels or 1))]
    for path in outputs:
        check_output(path, inputs, overwrite=overwrite)
    check_format(out, max_bytes)
    if report is not None:
        check_output(report, (*inputs, *outputs), overwrite=overwrite)
    settings = given_settings(context.params)
    if dry_run:
        print_plan(files, settings, out, opacity=opacity.value, hints=hints, as_json=json)
        return
    warn_of_memory(files, quiet=quiet or json)
    document = _run(
        files, settings, out, opacity=opacity.value, hints=hints, overwrite=overwrite, quiet=quiet or json,
        start=start, hashed=json or report is not None,
    )  # fmt: skip
    _tell(document, report, as_json=json, quiet=quiet, overwrite=overwrite)
    if document["unmet"]:
        raise TargetError(document["unmet"])


def warn_of_memory(files: SceneFiles, *, quiet: bool) -> None:
    """Say so before anything is read if the scene is not likely to fit into this machine's memory."""
    from gsmerge.io.formats.ply_file import header_counts
    from gsmerge.runtime.estimate import memory_bytes, memory_problem
    from gsmerge.runtime.memory import machine_memory

    count, num_rest = header_counts(files.ply)
    problem = memory_problem(memory_bytes(count, photos=True, num_rest=num_rest), machine_memory())
    if problem is not None:
        say(f"gsmerge: warning: {problem}", quiet=quiet)


def _run(
    files: SceneFiles,
    settings: CompactOptions,
    out: Path,
    *,
    opacity: OpacityChoice,
    hints: ReadHints,
    overwrite: bool,
    quiet: bool,
    start: float,
    hashed: bool,
) -> dict[str, Any]:
    """Read, compact and write; returns the report."""
    from gsmerge.compact_file import compact_files

    imported = perf_counter()
    with (
        announce_compilation(quiet=quiet, share=_fits_fully(settings)) as finish,
        stage_progress(quiet=quiet) as progress,
    ):

        def moved(stage: str, done: int, total: int) -> None:
            if stage == "fit":
                finish()
            if progress is not None:
                progress(stage, done, total)

        return compact_files(
            files, settings, out, opacity=opacity, hints=hints, overwrite=overwrite, progress=moved,
            hashed=hashed, seconds_before={"import": imported - start},
        )  # fmt: skip


def _fits_fully(settings: CompactOptions) -> bool:
    """Whether the kernels of the full fit will be needed."""
    return settings.method == "unmerged-fit" or (settings.method == "gsmerge" and settings.fit.fit == "full")


def _tell(document: Mapping[str, Any], report: Path | None, *, as_json: bool, quiet: bool, overwrite: bool) -> None:
    """The report where it was asked for: file, stdout, or one line."""
    from gsmerge.io import atomic_output
    from gsmerge.report import summary_lines, to_json

    say_notes(document["notes"], quiet=quiet or as_json)
    if report is not None:
        with atomic_output(report, overwrite=overwrite) as temporary:
            temporary.write_text(to_json(document))
    if as_json:
        sys.stdout.write(to_json(document))
    elif not quiet:
        print("\n".join(map(one_line, summary_lines(document))))


def print_plan(
    files: SceneFiles, settings: CompactOptions, out: Path, *, opacity: OpacityChoice, hints: ReadHints, as_json: bool
) -> None:
    """Say what would be done, as lines or JSON."""
    from gsmerge.baselines import choose_baseline
    from gsmerge.compact_file import read_input
    from gsmerge.options import to_schema
    from gsmerge.report import document_head, to_json
    from gsmerge.runtime.estimate import plan_document, plan_lines
    from gsmerge.runtime.threads import available_threads
    from gsmerge.stages.group import budget_count, default_count, superpixels_per_view

    given = read_input(files, opacity=opacity, hints=hints)
    scene, cameras = given.scene, given.scene.cameras
    with told_as_usage():
        wanted = budget_count(scene, settings)
    _, unused = choose_baseline(settings, scene)
    document = plan_document(
        {name: path and str(path) for name, path in vars(files).items()},
        (len(cameras), cameras.height, cameras.width),
        settings.resolved(photos=scene.images is not None),
        output_path=out,
        per_view=superpixels_per_view(scene, settings) if len(scene) else 0,
        photos=scene.images is not None,
        threads=settings.threads or available_threads(),
        fit_steps=settings.fit.steps,
        default_count=default_count(scene, settings),
        budget=wanted,
        notes=[*given.notes, *unused],
        count=scene.num_gaussians,
        num_rest=3 * scene.gaussians.shN.shape[1],
    )
    if as_json:
        options = {"options": to_schema(document["options"])}
        sys.stdout.write(to_json({**document_head(), **document, **options}))
    else:
        print("\n".join(map(one_line, plan_lines(document))))
