"""``gsmerge compact``: compact a scene, or decode the Feature Gaussians of ``gsmerge extend`` into Gaussians."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, NamedTuple

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say, say_notes, separate_stdout, stage_progress, terminal_columns
from gsmerge.cli.paths import check_outputs, default_output, input_files, output_file
from gsmerge.errors import Doubt, TargetError, UsageError, split_notes
from gsmerge.settings.compact import CHECKPOINTS, CompactOptions
from gsmerge.settings.files import FileOptions
from gsmerge.settings.reading import NONE
from gsmerge.settings.stages import Engine

if TYPE_CHECKING:
    from gsmerge.compaction.outputs import Outputs
    from gsmerge.io.scene_files import SceneFiles
    from gsmerge.scene.exporters import ReadHints
    from gsmerge.scene.read import Loaded

REMEDY = "more Gaussians (--k, --budget) or a longer fit (--effort) show them better"
# Arguments and options that also apply if the input is a .gsm of Feature Gaussians
FEATURE_OPTIONS = ("scenes", "k", "set", "output", "overwrite", "dry_run", "open", "json", "quiet", "threads")


PARAMETERS = (
    opt.argument("scenes", list[Path], "SCENE...", "A .ply of Gaussians, or the folder that holds it. "
                 "Several scenes of one place, as SHARP writes them, are joined. Or a .gsm of gsmerge extend."),
    f"{opt.READING} masks protect budget quality levels k effort fit",
    opt.settings_option(CompactOptions, FileOptions, Engine),
    "crop drop",
    opt.output(f"{opt.COMPACT_SCENE} .html: one page with a viewer, to send. lod-meta.json: levels for streaming. "
               "A folder gets SCENE.compact.ply.", "SCENE.compact.ply"),
    "overwrite strict dry_run seed threads",
)  # fmt: skip


class FeatureFile(NamedTuple):
    """An input of Feature Gaussians, in place of a scene."""

    base: Path  # The .gsm, after which the output is named


@opt.command(*PARAMETERS)
def compact(args: opt.Args) -> None:
    """Write a compact scene that renders like the given one, or better, with 1 to 10 % of its Gaussians."""
    _compact(args, *_find_input(args))


@opt.command(*PARAMETERS, "open")
def look(args: opt.Args) -> None:
    """Compact a scene, and open a page that compares it with the result: ``gsmerge SCENE``."""
    source, out = _find_input(args)
    # A page cannot show joined scenes or Feature Gaussians, so only the result is shown
    on_page = [out] if isinstance(source, FeatureFile) or len(args.scenes) > 1 else [args.scenes[0], out]
    if os.path.exists(out) and not (args.overwrite or args.dry_run):
        view_command = shlex.join(["gsmerge", "view", *map(str, on_page)])
        raise UsageError(f"{out}: exists already; {view_command} shows it, --overwrite makes it again")
    loads: list[Loaded] = []
    _compact(args, source, out, loads.append)
    from gsmerge.io.formats.table import VIEWED

    if args.dry_run or out.suffix.lower() not in VIEWED:
        return
    from gsmerge.cli.view_command import view

    before, *after = on_page
    cameras = args.get_given(("cameras", "images", "masks", "protect", "hint")) if after else {}
    loaded = replace(loads[0], notes=()) if after else None  # its notes have been printed already
    opens = args.open and not args.json
    opt.call(view, before=before, after=after, **cameras, open=opens, quiet=args.silent, loaded=loaded)


def _find_input(args: opt.Args) -> tuple[SceneFiles | FeatureFile, Path]:
    """Return what the command reads, which is a scene or a file of Feature Gaussians, and the path of the output."""
    source: SceneFiles | FeatureFile | None = _find_features(args.scenes)
    if source is None:
        _check_scenes(args)
        source = args.files(*args.scenes)
    default = default_output(source.base)
    return source, output_file(args.output or default, default.name)


def _compact(
    args: opt.Args, source: SceneFiles | FeatureFile, out: Path, on_read: Callable[[Loaded], None] | None = None
) -> None:
    """Compact a scene, or decode Feature Gaussians; ``on_read`` is called with the scene that was read, if any.

    With ``on_read`` the caller shows the result on a page.
    """
    if isinstance(source, FeatureFile):
        _decode_features(args, source.base, out)
        return
    hints = args.hints()
    settings, writing, engine = args.make(CompactOptions, FileOptions, Engine)
    settings = replace(settings, blocks=replace(settings.blocks, engine=engine))
    if engine.engine == "ray" and not args.dry_run:
        from gsmerge.runtime.work import require_ray

        require_ray()
    from gsmerge.compaction.outputs import name_outputs

    outputs = name_outputs(out, writing, overwrite=args.overwrite)
    settings = _choose_levels(args, settings, outputs)
    _check_outputs(args, source, settings, outputs)
    if args.dry_run:
        print_estimate(args, source, settings, outputs, hints)
        return
    _warn_of_memory(source, settings, quiet=args.silent)
    from gsmerge.compaction.compact import compact_files

    seconds_before = {"import": perf_counter() - args.start}
    with separate_stdout(engine.engine, quiet=args.silent), stage_progress(quiet=args.silent) as progress:
        document = compact_files(
            source, settings, outputs, opacity=args.opacity, hints=hints, progress=progress,
            hashed=args.json, seconds_before=seconds_before, on_read=on_read or (lambda _: None),
        )  # fmt: skip
    _print_result(args, document, out, shown=on_read is not None)
    _judge_result(args, document)


def _choose_levels(args: opt.Args, settings: CompactOptions, outputs: Outputs) -> CompactOptions:
    """Choose the number of levels by the format of the output, and check that the format allows the settings.

    UsageError if there are several levels, or a budget in bytes, and the format cannot have these.
    """
    from gsmerge.facts.counts import STREAMED_LEVELS

    out, format_ = outputs.result, outputs.format
    if format_.levels == "inside" and settings.method == "gsmerge" and "levels" not in args.values(CompactOptions):
        settings = settings.with_settings({"levels": STREAMED_LEVELS})
    if not format_.levels and settings.budget.levels > 1:
        levels, kind = settings.budget.levels, format_.about.partition(":")[0]
        raise UsageError(f"{out}: expected one level in {kind}, found --levels {levels}; drop --levels")
    if settings.budget.in_bytes and not format_.gaussian_bytes:
        raise UsageError(f"{out}: expected a --budget in Gaussians for this format, got {settings.budget.budget}")
    return settings


def _check_outputs(args: opt.Args, files: SceneFiles, settings: CompactOptions, outputs: Outputs) -> None:
    """Raise an error if a file of the result cannot be written."""
    from gsmerge.io.formats.write import level_output

    num_files = settings.budget.levels if outputs.format.levels == "apart" else 1
    levels = [level_output(outputs.result, level) for level in range(1, num_files)]
    networks = [] if settings.checkpoint in CHECKPOINTS else [Path(settings.checkpoint)]
    # Results in several formats share a camera file, which may exist already, unless --overwrite replaces it
    replaced_cameras = outputs.viewer_cameras if args.overwrite else None
    paths = (*outputs.paths, *levels, replaced_cameras)
    check_outputs(paths, (*input_files(files), *networks), overwrite=args.overwrite or args.dry_run)
    if outputs.options.columns == "full" and settings.budget.in_bytes:
        raise UsageError(f"columns full: expected a --budget that is a number or a share, got {settings.budget.budget}")


def _print_result(args: opt.Args, document: Mapping[str, Any], out: Path, *, shown: bool) -> None:
    """Print the report of a run and, unless a page will show the result (``shown``), how to view it."""
    from gsmerge.compaction.report import result_table

    notes = split_notes(document["notes"], "worse")[1]  # :func:`_judge_result` prints the others
    say_notes([note for note in notes if not (args.strict and isinstance(note, Doubt))], quiet=args.silent)
    columns = terminal_columns(sys.stdout)
    next_step = None if columns is None or shown else _view_command(args.scenes[0], out)
    lines = result_table(document, next_step, columns=columns)
    print_document(document, lines, as_json=args.json, quiet=args.quiet, wrap=False)


def _view_command(scene: Path, out: Path) -> str | None:
    """Return the command that compares a scene with its result on a page; None if a page cannot show the format."""
    from gsmerge.io.formats.table import VIEWED

    if out.suffix.lower() not in VIEWED:
        return None
    # ./ before a path that begins with a dash shows that the path is not an option
    paths = [f"./{path}" if str(path)[0] == "-" else str(path) for path in (scene, out)]
    return shlex.join(["gsmerge", "view", *paths])


def _judge_result(args: opt.Args, document: Mapping[str, Any]) -> None:
    """Warn of a result that is worse than its input; TargetError for a missed target or, with ``--strict``, a doubt."""
    psnr, worse, keeps_fidelity = document["psnr_input_views"], document["worse"], "fidelity" in document["choices"]
    if args.strict and not (worse or keeps_fidelity) and psnr["before"] is None:
        say_notes(["--strict: nothing was checked, since there is no photo to compare with"], quiet=args.silent)
    if worse and not args.strict:
        has_loss = keeps_fidelity or (psnr["after"] is not None and psnr["after"] < psnr["before"])
        say(f"{worse}; {REMEDY}" if has_loss else worse, kind="warning", quiet=args.silent)
    problems = [document["unmet"], *(document["doubts"] if args.strict else [])]
    if any(problems):
        raise TargetError("; ".join(filter(None, problems)))


def _decode_features(args: opt.Args, path: Path, out: Path) -> None:
    """Decode the Feature Gaussians of a ``.gsm``, and write the result."""
    if len(args.scenes) > 1:
        raise UsageError(f"{path}: expected Feature Gaussians as the only input, got {len(args.scenes)} inputs")
    args.refuse_options(FEATURE_OPTIONS, path)
    from gsmerge.compaction.outputs import name_outputs
    from gsmerge.settings.stages import DecodeOptions
    from gsmerge.states.files import decode_file, decoding_line

    decoding, writing = args.make(DecodeOptions, FileOptions, columns="needed")
    outputs = name_outputs(out, writing, overwrite=args.overwrite)
    check_outputs(outputs.paths, (path,), overwrite=args.overwrite or args.dry_run)
    before = {"import": perf_counter() - args.start}
    document = decode_file(path, outputs, decoding, dry_run=args.dry_run, seconds_before=before)
    say_notes(document["notes"], quiet=args.silent)
    print_document(document, decoding_line(document), as_json=args.json, quiet=args.quiet and not args.dry_run)


def _find_features(scenes: Sequence[Path]) -> FeatureFile | None:
    """Return the first input that is a ``.gsm`` of Feature Gaussians; None if no input is one."""
    from gsmerge.io.formats.table import STATE_ENDING

    states = [path for path in scenes if path.suffix.lower() == STATE_ENDING and path.is_file()]
    if not states:
        return None
    from gsmerge.states.state_file import holds_features

    return next((FeatureFile(path) for path in states if holds_features(path)), None)


def _check_scenes(args: opt.Args) -> None:
    """Raise UsageError if several scenes cannot be joined.

    Scenes cannot be joined if ``--cameras`` names one file for all, or if a scene is missing, given twice, or a result.
    """
    if len(args.scenes) == 1:
        return
    if args.cameras not in (None, NONE):
        problem = "--cameras: expected one scene with it, got several"
        raise UsageError(f"{problem}; the cameras of several scenes are read from beside or inside them")
    from gsmerge.io.formats.ply import header_content

    remedy = "" if args.output else "; name the output with -o"
    for i, scene in enumerate(args.scenes):
        if not os.path.lexists(scene):
            raise UsageError(f"{scene}: no such scene{remedy}")
        if any(os.path.realpath(scene) == os.path.realpath(other) for other in args.scenes[:i]):
            raise UsageError(f"{scene}: expected each scene once, got it twice{remedy}")
        if scene.is_file() and header_content(scene) == "result":
            raise UsageError(f"{scene}: expected scenes to join, found a result of gsmerge{remedy}")


def _warn_of_memory(files: SceneFiles, settings: CompactOptions, *, quiet: bool) -> None:
    """Warn before reading if the scene, or the largest of its blocks, is not likely to fit into memory."""
    from gsmerge.compaction.partition import gaussians_at_once
    from gsmerge.io.formats.table import estimate_counts
    from gsmerge.plan import wanted_blocks
    from gsmerge.runtime.memory import memory_bytes, memory_problem

    count, num_rest = estimate_counts([ply for scene_files in (files, *files.more) for ply in scene_files.plys])
    at_once = gaussians_at_once(count, wanted_blocks(settings, count))
    needed = memory_bytes(at_once, num_rest=num_rest, num_elsewhere=count - at_once)
    problem = memory_problem(needed)
    if problem is not None:
        say(problem, kind="warning", quiet=quiet)


def print_estimate(
    args: opt.Args, files: SceneFiles, settings: CompactOptions, outputs: Outputs, hints: ReadHints
) -> None:
    """Print an estimate of the result that ``compact`` would make."""
    from gsmerge.compaction.estimate import dry_run_lines, estimate_files
    from gsmerge.compaction.files import read_input

    load = read_input(files, opacity=args.opacity, hints=hints)
    with opt.usage_errors():
        document = estimate_files(load, settings, outputs)
    print_document(document, dry_run_lines(document), as_json=args.json)
