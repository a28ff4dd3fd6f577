"""``gsmerge compact``: the main job."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, say_notes, stage_progress
from gsmerge.cli.paths import check_output, default_output, input_files
from gsmerge.cli.settings import superpixels_per_view, told_as_usage

if TYPE_CHECKING:
    from gsmerge.io import SceneFiles, SceneLoad
    from gsmerge.io.ply import OpacityChoice
    from gsmerge.options import CompactOptions
    from gsmerge.types import PixelScene


def compact(
    scene: opt.SceneArgument,
    cameras: opt.CamerasOption = None,
    images: opt.ImagesOption = None,
    opacity: opt.OpacityOption = opt.Opacity.auto,
    superpixels: opt.SuperpixelsOption = None,
    density: opt.DensityOption = None,
    method: opt.MethodOption = None,
    preset: opt.PresetOption = None,
    k: opt.KOption = None,
    robust: opt.RobustOption = None,
    match: opt.MatchOption = None,
    fit: opt.FitOption = None,
    fit_steps: opt.FitStepsOption = None,
    time_budget: opt.TimeBudgetOption = None,
    budget: opt.BudgetOption = None,
    max_bytes: opt.MaxBytesOption = None,
    unseen: opt.UnseenOption = None,
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
    """Write a compact .ply that renders like the scene, or better, with 1 to 10 % of its Gaussians."""
    start = perf_counter()
    from gsmerge.io import find_scene_files

    files = find_scene_files(scene, cameras=cameras, images=images)
    out = output or default_output(files.ply)
    inputs = input_files(files)
    check_output(out, inputs, overwrite=overwrite)
    if report is not None:
        check_output(report, (*inputs, out), overwrite=overwrite)
    chosen: dict[str, Any] = {
        "k": k,
        "superpixels": superpixels,
        "density": density,
        "method": method,
        "preset": preset,
    }
    chosen |= {"robust": robust, "match": match, "fit": fit, "fit_steps": fit_steps, "time_budget": time_budget}
    chosen |= {"budget": budget, "max_bytes": max_bytes, "unseen": unseen}
    chosen |= {"seed": seed, "threads": threads}
    settings = _settings(chosen)
    if dry_run:
        _print_plan(files, settings, out, opacity=opacity.value, as_json=json)
        return
    document = _run(
        files, settings, out, opacity=opacity.value, overwrite=overwrite, quiet=quiet or json, start=start,
        hashed=json or report is not None,
    )  # fmt: skip
    _tell(document, report, as_json=json, quiet=quiet, overwrite=overwrite)


def _settings(chosen: Mapping[str, Any]) -> CompactOptions:
    """The library's options with those that were given."""
    from gsmerge.options import CompactOptions

    given = {name: value.value if isinstance(value, Enum) else value for name, value in chosen.items()}
    with told_as_usage():
        return CompactOptions().with_settings({name: value for name, value in given.items() if value is not None})


def _run(
    files: SceneFiles,
    settings: CompactOptions,
    out: Path,
    *,
    opacity: OpacityChoice,
    overwrite: bool,
    quiet: bool,
    start: float,
    hashed: bool,
) -> dict[str, Any]:
    """Read, compact and write; returns the report."""
    from gsmerge import pipeline
    from gsmerge.io import align_scene, atomic_output, read_ply, write_ply
    from gsmerge.report import report_document

    imported = perf_counter()
    with atomic_output(out, overwrite=overwrite) as temporary:
        loaded = align_scene(read_ply(files.ply, opacity=opacity), files)
        superpixels_per_view(settings.segment, loaded.scene.cameras.width, loaded.scene.cameras.height)
        read = perf_counter()
        with (
            announce_compilation(quiet=quiet, share=settings.fit.fit == "full") as finish,
            stage_progress(quiet=quiet) as progress,
        ):

            def moved(stage: str, done: int, total: int) -> None:
                if stage == "fit":
                    finish()
                if progress is not None:
                    progress(stage, done, total)

            result = pipeline.compact(loaded.scene, settings, progress=moved)
        compacted = perf_counter()
        write_ply(temporary, result.gaussians, overwrite=True)
    return report_document(
        result.report,
        input_path=files.ply,
        output_path=out,
        seconds_before={"import": imported - start, "read": read - imported},
        seconds_after={"write": perf_counter() - compacted},
        recognised=_recognised(loaded),
        notes=loaded.notes,
        hashed=hashed,
    )


def _recognised(loaded: SceneLoad) -> dict[str, Any]:
    """What the report says about the input."""
    names = ("layout", "sh_degree", "opacity_encoding", "num_nonfinite")
    cameras = loaded.scene.cameras
    views = {"num_views": len(cameras), "height": cameras.height, "width": cameras.width}
    return views | {name: getattr(loaded.ply, name) for name in names}


def _tell(document: Mapping[str, Any], report: Path | None, *, as_json: bool, quiet: bool, overwrite: bool) -> None:
    """The report where it was asked for: file, stdout, or one line."""
    from gsmerge.io import atomic_output
    from gsmerge.report import summary_line, to_json

    say_notes(document["notes"], quiet=quiet or as_json)
    if report is not None:
        with atomic_output(report, overwrite=overwrite) as temporary:
            temporary.write_text(to_json(document))
    if as_json:
        sys.stdout.write(to_json(document))
    elif not quiet:
        print(summary_line(document))


def _print_plan(
    files: SceneFiles, settings: CompactOptions, out: Path, *, opacity: OpacityChoice, as_json: bool
) -> None:
    from gsmerge.io import align_scene, read_ply
    from gsmerge.report import plan_document, plan_lines, to_json
    from gsmerge.threads import available_threads

    loaded = align_scene(read_ply(files.ply, opacity=opacity), files)
    scene, cameras = loaded.scene, loaded.scene.cameras
    document = plan_document(
        {name: path and str(path) for name, path in vars(files).items()},
        (len(cameras), cameras.height, cameras.width),
        settings.to_dict(),
        output_path=out,
        per_view=superpixels_per_view(settings.segment, cameras.width, cameras.height),
        photos=scene.images is not None,
        threads=settings.threads or available_threads(),
        wanted=_wanted(scene, settings),
        notes=loaded.notes,
    )
    if as_json:
        sys.stdout.write(to_json(document))
    else:
        print("\n".join(plan_lines(document)))


def _wanted(scene: PixelScene, settings: CompactOptions) -> int | None:
    """Gaussians that a budget or a file size asks for, refused as wrong usage where that cannot be."""
    from gsmerge.grouping import target_count

    with told_as_usage():
        return target_count(scene, settings)
