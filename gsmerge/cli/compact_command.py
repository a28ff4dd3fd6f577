"""``gsmerge compact``: compact a scene, or decode the Feature Gaussians of ``gsmerge extend`` into Gaussians."""

import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say, say_notes, separate_stdout, stage_progress, terminal_columns
from gsmerge.cli.paths import check_outputs, default_output, input_files, output_file
from gsmerge.errors import Doubt, TargetError, UsageError, split_notes
from gsmerge.settings.compact import CHECKPOINTS, CompactOptions
from gsmerge.settings.files import FileOptions
from gsmerge.settings.reading import NONE
from gsmerge.settings.stages import Engine

if TYPE_CHECKING:
    from gsmerge.reading.read_scene import Loaded
    from gsmerge.reading.scene_files import SceneFiles
    from gsmerge.results.outputs import Outputs

SETTINGS = (CompactOptions, FileOptions, Engine)
REMEDY = "more Gaussians (--k, --budget) or a longer fit (--effort) show them better"
# Arguments and options that also apply if the input is a .gsm of Feature Gaussians
FEATURE_OPTIONS = ("scenes", "k", "set", "output", "overwrite", "dry_run", "open", "json", "quiet", "threads",
                   "progress")  # fmt: skip


@dataclass(frozen=True)
class Run:
    """How a call of the command runs, besides its settings."""

    scene: Path  # the first input
    out: Path
    start: float  # when the command began
    overwrite: bool
    dry_run: bool
    strict: bool
    json: bool
    quiet: bool
    has_page: bool  # true if a page will show the result

    @property
    def silent(self) -> bool:
        """True if no text is printed, but JSON or nothing."""
        return self.quiet or self.json


def compact(
    context: typer.Context,
    scenes: Annotated[list[Path], opt.argument("SCENE...", "A .ply of Gaussians, or the folder that holds it. Several "
        "scenes of one place, as SHARP writes them, are joined. Or a .gsm of gsmerge extend.")],
    cameras: opt.Cameras = None, images: opt.Images = None, hint: opt.Hint = None, masks: opt.Masks = None,
    protect: opt.Protect = None, budget: opt.Budget = None, quality: opt.Quality = None, levels: opt.Levels = None,
    k: opt.K = None, effort: opt.Effort = None, fit: opt.Fit = None,
    set: Annotated[list[str] | None, opt.settings_option(SETTINGS)] = None,
    crop: opt.Crop = None, drop: opt.Drop = None,
    output: Annotated[Path | None, opt.output(f"{opt.COMPACT_SCENE} .html: one page with a viewer, to send. "
        "lod-meta.json: levels for streaming. A folder gets SCENE.compact.ply.", "SCENE.compact.ply")] = None,
    overwrite: opt.Overwrite = False, strict: opt.Strict = False, dry_run: opt.DryRun = False,
    open: Annotated[bool | None, opt.option(opt.OUTPUT, "", "Also make a page that compares the scene with the result, "
        "and open it in the browser.", "--open/--no-open", default="no page; --open for gsmerge SCENE")] = None,
    seed: opt.Seed = None, threads: opt.Threads = None, json: opt.Json = False, progress: opt.Progress = None,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Write a compact scene that renders like the given one, or better, with 1 to 10 % of its Gaussians."""
    start = perf_counter()
    given = opt.read_settings(
        SETTINGS, set, budget=budget, quality=quality, levels=levels, k=k, effort=effort, fit=fit, crop=crop, drop=drop,
        seed=seed, threads=threads,
    )  # fmt: skip
    settings, writing, engine = given.make(*SETTINGS)
    settings = replace(settings, blocks=replace(settings.blocks, engine=engine))
    features = _find_features(scenes)
    source = features or _find_files(scenes, output, cameras, images=images, masks=masks, protect=protect)
    default = default_output(source if isinstance(source, Path) else source.base)
    out = output_file(output or default, default.name)
    run = Run(scenes[0], out, start, overwrite, dry_run, strict, json, quiet, has_page=open is not None)
    # A page cannot show joined scenes or Feature Gaussians, so only the result is shown
    on_page = [scenes[0], out] if features is None and len(scenes) == 1 else [out]
    if run.has_page and os.path.exists(out) and not (overwrite or dry_run):
        view_command = shlex.join(["gsmerge", "view", *map(str, on_page)])
        raise UsageError(f"{out}: exists already; {view_command} shows it, --overwrite makes it again")
    loaded = None
    if isinstance(source, Path):
        _refuse_options(context, source)
        _decode_features(source, given, run)
    else:
        has_levels = "levels" in given.values
        loaded = _compact_files(source, settings, writing, opt.read_hints(hint), run, has_levels=has_levels)
    if run.has_page and not dry_run:
        _show_page(on_page, loaded, run, open=bool(open))


def _compact_files(
    files: "SceneFiles", settings: CompactOptions, writing: FileOptions, reading: opt.Reading, run: Run, *,
    has_levels: bool,
) -> "Loaded | None":  # fmt: skip
    """Compact a scene, and return it as it was read; with ``--dry-run`` print an estimate instead.

    ``has_levels``: the user gave the number of levels.
    """
    engine = settings.blocks.engine.engine
    if engine == "ray" and not run.dry_run:
        from gsmerge.runtime.work import require_ray

        require_ray()
    from gsmerge.results.outputs import name_outputs

    outputs = name_outputs(run.out, writing, overwrite=run.overwrite)
    settings = _choose_levels(settings, outputs, has_levels=has_levels)
    _check_outputs(files, settings, outputs, overwrite=run.overwrite or run.dry_run)
    if run.dry_run:
        print_estimate(files, settings, outputs, reading, as_json=run.json)
        return None
    _warn_of_memory(files, settings, quiet=run.silent)
    from gsmerge.road import compact_files

    loads: list[Loaded] = []
    seconds_before = {"import": perf_counter() - run.start}
    with separate_stdout(engine, quiet=run.silent), stage_progress(quiet=run.silent) as progress:
        document = compact_files(
            files, settings, outputs, opacity=reading.opacity, hints=reading.hints, progress=progress,
            hashed=run.json, seconds_before=seconds_before, on_read=loads.append,
        )  # fmt: skip
    _print_result(document, run)
    _judge_result(document, run)
    return loads[0]


def _show_page(on_page: Sequence[Path], loaded: "Loaded | None", run: Run, *, open: bool) -> None:
    """Show the result on a page, beside the scene that was ``loaded`` if ``on_page`` has both."""
    from gsmerge.cli.view_command import show_page
    from gsmerge.io.formats.table import VIEWED
    from gsmerge.reading.scene_files import find_scene_files

    if run.out.suffix.lower() not in VIEWED:
        return
    before, *after = on_page
    if loaded is None or not after:
        show_page(find_scene_files(before), [], open=open and not run.json, quiet=run.silent)
    else:
        loaded = replace(loaded, notes=())  # its notes have been printed already
        show_page(loaded.files, after, loaded=loaded, open=open and not run.json, quiet=run.silent)


def _choose_levels(settings: CompactOptions, outputs: "Outputs", *, has_levels: bool) -> CompactOptions:
    """Choose the number of levels by the format of the output, and check that the format allows the settings.

    UsageError if there are several levels, or a budget in bytes, and the format cannot have these.
    """
    from gsmerge.stages.counts import STREAMED_LEVELS

    out, format_ = outputs.result, outputs.format
    if format_.levels == "inside" and settings.method == "gsmerge" and not has_levels:
        settings = settings.with_settings({"levels": STREAMED_LEVELS})
    if not format_.levels and settings.budget.levels > 1:
        levels, kind = settings.budget.levels, format_.about.partition(":")[0]
        raise UsageError(f"{out}: expected one level in {kind}, found --levels {levels}; drop --levels")
    if settings.budget.in_bytes and not format_.gaussian_bytes:
        raise UsageError(f"{out}: expected a --budget in Gaussians for this format, got {settings.budget.budget}")
    return settings


def _check_outputs(files: "SceneFiles", settings: CompactOptions, outputs: "Outputs", *, overwrite: bool) -> None:
    """Raise an error if a file of the result cannot be written."""
    from gsmerge.io.formats.write import level_output

    num_files = settings.budget.levels if outputs.format.levels == "apart" else 1
    levels = [level_output(outputs.result, level) for level in range(1, num_files)]
    networks = [] if settings.checkpoint in CHECKPOINTS else [Path(settings.checkpoint)]
    # Results in several formats share a camera file, which may exist already, unless --overwrite replaces it
    replaced_cameras = outputs.viewer_cameras if outputs.overwrite else None
    paths = (*outputs.paths, *levels, replaced_cameras)
    check_outputs(paths, (*input_files(files), *networks), overwrite=overwrite)
    if outputs.options.columns == "full" and settings.budget.in_bytes:
        raise UsageError(f"columns full: expected a --budget that is a number or a share, got {settings.budget.budget}")


def _print_result(document: Mapping[str, Any], run: Run) -> None:
    """Print the report of a run and, unless a page will show the result, how to view it."""
    from gsmerge.results.report import result_table

    notes = split_notes(document["notes"], "worse")[1]  # :func:`_judge_result` prints the others
    say_notes([note for note in notes if not (run.strict and isinstance(note, Doubt))], quiet=run.silent)
    columns = terminal_columns(sys.stdout)
    next_step = None if columns is None or run.has_page else _view_command(run.scene, run.out)
    lines = result_table(document, next_step, columns=columns)
    print_document(document, lines, as_json=run.json, quiet=run.quiet, wrap=False)


def _view_command(scene: Path, out: Path) -> str | None:
    """Return the command that compares a scene with its result on a page; None if a page cannot show the format."""
    from gsmerge.io.formats.table import VIEWED

    if out.suffix.lower() not in VIEWED:
        return None
    # ./ before a path that begins with a dash shows that the path is not an option
    paths = [f"./{path}" if str(path)[0] == "-" else str(path) for path in (scene, out)]
    return shlex.join(["gsmerge", "view", *paths])


def _judge_result(document: Mapping[str, Any], run: Run) -> None:
    """Warn of a result that is worse than its input; TargetError for a missed target or, with ``--strict``, a doubt."""
    psnr, worse, keeps_fidelity = document["psnr_input_views"], document["worse"], "fidelity" in document["choices"]
    if run.strict and not (worse or keeps_fidelity) and psnr["before"] is None:
        say_notes(["--strict: nothing was checked, since there is no photo to compare with"], quiet=run.silent)
    if worse and not run.strict:
        has_loss = keeps_fidelity or (psnr["after"] is not None and psnr["after"] < psnr["before"])
        say(f"{worse}; {REMEDY}" if has_loss else worse, kind="warning", quiet=run.silent)
    problems = [document["unmet"], *(document["doubts"] if run.strict else [])]
    if any(problems):
        raise TargetError("; ".join(filter(None, problems)))


def _refuse_options(context: typer.Context, path: Path) -> None:
    """Raise UsageError for an option that does not apply to the Feature Gaussians in ``path``."""
    for name, value in context.params.items():
        if value not in (None, False, [], ()) and name not in FEATURE_OPTIONS:
            flag = f"--{name.replace('_', '-')}"
            problem = f"expected a scene with it, but {path} holds Feature Gaussians; their number is set by --k"
            raise UsageError(f"{flag}: {problem}")


def _decode_features(path: Path, given: opt.Given, run: Run) -> None:
    """Decode the Feature Gaussians of a ``.gsm``, and write the result."""
    from gsmerge.jobs.states.files import decode_file, decoding_line
    from gsmerge.results.outputs import name_outputs
    from gsmerge.settings.stages import DecodeOptions

    decoding, writing = given.make(DecodeOptions, FileOptions, columns="needed")
    outputs = name_outputs(run.out, writing, overwrite=run.overwrite)
    check_outputs(outputs.paths, (path,), overwrite=run.overwrite or run.dry_run)
    before = {"import": perf_counter() - run.start}
    document = decode_file(path, outputs, decoding, dry_run=run.dry_run, seconds_before=before)
    say_notes(document["notes"], quiet=run.silent)
    print_document(document, decoding_line(document), as_json=run.json, quiet=run.quiet and not run.dry_run)


def _find_features(scenes: Sequence[Path]) -> Path | None:
    """Return the input if it is a ``.gsm`` of Feature Gaussians; UsageError if it is one of several inputs."""
    from gsmerge.io.formats.table import STATE_ENDING

    states = [path for path in scenes if path.suffix.lower() == STATE_ENDING and path.is_file()]
    if not states:
        return None
    from gsmerge.jobs.states.state_file import holds_features

    path = next(filter(holds_features, states), None)
    if path is not None and len(scenes) > 1:
        raise UsageError(f"{path}: expected Feature Gaussians as the only input, got {len(scenes)} inputs")
    return path


def _find_files(scenes: Sequence[Path], output: Path | None, cameras: Any, **named: Any) -> "SceneFiles":
    """Find the files of a scene, and of further scenes to join with it: those named, or those beside each scene."""
    from gsmerge.reading.scene_files import find_scene_files

    if len(scenes) > 1:
        _check_scenes(scenes, output, cameras)
    files, *more = (find_scene_files(path, cameras=cameras, **named) for path in scenes)
    return replace(files, more=tuple(more))


def _check_scenes(scenes: Sequence[Path], output: Path | None, cameras: Path | str | None) -> None:
    """Raise UsageError if several scenes cannot be joined.

    Scenes cannot be joined if ``--cameras`` names one file for all, or if a scene is missing, given twice, or a result.
    """
    if cameras not in (None, NONE):
        problem = "--cameras: expected one scene with it, got several"
        raise UsageError(f"{problem}; the cameras of several scenes are read from beside or inside them")
    from gsmerge.io.formats.ply import header_content

    remedy = "" if output else "; name the output with -o"
    for i, scene in enumerate(scenes):
        if not os.path.lexists(scene):
            raise UsageError(f"{scene}: no such scene{remedy}")
        if any(os.path.realpath(scene) == os.path.realpath(other) for other in scenes[:i]):
            raise UsageError(f"{scene}: expected each scene once, got it twice{remedy}")
        if scene.is_file() and header_content(scene) == "result":
            raise UsageError(f"{scene}: expected scenes to join, found a result of gsmerge{remedy}")


def _warn_of_memory(files: "SceneFiles", settings: CompactOptions, *, quiet: bool) -> None:
    """Warn before reading if the scene, or the largest of its blocks, is not likely to fit into memory."""
    from gsmerge.io.formats.table import estimate_counts
    from gsmerge.plan import wanted_blocks
    from gsmerge.runtime.memory import memory_bytes, memory_problem
    from gsmerge.special.blocks.partition import gaussians_at_once

    count, num_rest = estimate_counts([ply for scene_files in (files, *files.more) for ply in scene_files.plys])
    at_once = gaussians_at_once(count, wanted_blocks(settings, count))
    needed = memory_bytes(at_once, num_rest=num_rest, num_elsewhere=count - at_once)
    problem = memory_problem(needed)
    if problem is not None:
        say(problem, kind="warning", quiet=quiet)


def print_estimate(
    files: "SceneFiles", settings: CompactOptions, outputs: "Outputs", reading: opt.Reading, *, as_json: bool
) -> None:
    """Print an estimate of the result that ``compact`` would make."""
    from gsmerge.jobs.estimate import dry_run_lines, estimate_files
    from gsmerge.reading.input import read_input

    load = read_input(files, opacity=reading.opacity, hints=reading.hints)
    with opt.usage_errors():
        document = estimate_files(load, settings, outputs)
    print_document(document, dry_run_lines(document), as_json=as_json)
