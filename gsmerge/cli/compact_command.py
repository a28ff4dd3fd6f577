"""``gsmerge compact``: compact a scene, or decode the Feature Gaussians of ``gsmerge extend`` into Gaussians."""

import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say, say_notes, separate_stdout, stage_progress, terminal_columns
from gsmerge.cli.paths import check_outputs, input_files, output_file
from gsmerge.errors import Doubt, SceneError, TargetError, UsageError, split_notes
from gsmerge.frozen import asdict, dataclass, replace
from gsmerge.settings.compact import CHECKPOINTS, CompactOptions
from gsmerge.settings.files import FileOptions
from gsmerge.settings.reading import NONE
from gsmerge.settings.stages import Engine

if TYPE_CHECKING:
    from gsmerge.reading.choice import Choice
    from gsmerge.reading.read_scene import Loaded
    from gsmerge.reading.scene_files import SceneFiles

SETTINGS = (CompactOptions, FileOptions, Engine)
REMEDY = "more Gaussians (--k, --budget) or a longer fit (--effort) show them better"
# Arguments and options that also apply if the input is a .gsm of Feature Gaussians
FEATURE_OPTIONS = ("scenes", "k", "set", "output", "overwrite", "dry_run", "open", "json", "verbose", "quiet",
                   "threads", "progress")  # fmt: skip


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
    verbose: bool
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
        "and open it in the browser, or with --no-open only make it.", "--open/--no-open",
        default="no page; --open for gsmerge SCENE")] = None,
    seed: opt.Seed = None, threads: opt.Threads = None, json: opt.Json = False, progress: opt.Progress = None,
    verbose: opt.Verbose = False, quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Write a compact scene that renders like the given one, or better, with 1 to 10 % of its Gaussians."""
    start = perf_counter()
    from gsmerge.io.formats.table import STATE_ENDING

    given = opt.read_settings(
        SETTINGS, set, budget=budget, quality=quality, levels=levels, k=k, effort=effort, fit=fit, crop=crop, drop=drop,
        seed=seed, threads=threads,
    )  # fmt: skip
    settings, writing, engine = given.make(*SETTINGS)
    has_levels = "levels" in given.values
    settings = replace(settings, blocks=replace(settings.blocks, engine=engine))
    # The input may be a .gsm of Feature Gaussians
    states = [path for path in scenes if path.suffix.lower() == STATE_ENDING and path.is_file()]
    features = None
    if states:
        from gsmerge.jobs.states.state_file import holds_features

        features = next(filter(holds_features, states), None)
    if features is not None and len(scenes) > 1:
        raise UsageError(f"{features}: expected Feature Gaussians as the only input, got {len(scenes)} inputs")
    source = features or _find_files(scenes, output, cameras, images=images, masks=masks, protect=protect)
    base = source if isinstance(source, Path) else source.base
    out = output_file(output or base.parent, f"{base.stem}.compact.ply")
    run = Run(
        scenes[0], out=out, start=start, overwrite=overwrite, dry_run=dry_run, strict=strict, json=json,
        verbose=verbose, quiet=quiet, has_page=open is not None,
    )  # fmt: skip
    # A page cannot show joined scenes or Feature Gaussians, so only the result is shown
    on_page = [scenes[0], out] if features is None and len(scenes) == 1 else [out]
    if run.has_page and os.path.exists(out) and not (overwrite or dry_run):
        view_command = shlex.join(["gsmerge", "view", *map(str, on_page)])
        raise UsageError(f"{out}: exists already; {view_command} shows it, --overwrite makes it again")
    loaded, changes = None, list[str]()
    if isinstance(source, Path):
        _decode_features(context, source, given, run)
    else:
        try:
            loaded, changes = _compact_files(source, settings, writing, hint, run, has_levels=has_levels)
        except SceneError as error:
            _print_candidates(error.candidates, run)
            raise
    if run.has_page and not dry_run:
        _show_page(on_page, loaded, changes, run, open=bool(open))


def _compact_files(
    files: "SceneFiles", settings: CompactOptions, writing: FileOptions, hint: Sequence[str] | None, run: Run, *,
    has_levels: bool,
) -> "tuple[Loaded | None, list[str]]":  # fmt: skip
    """Compact a scene; return it as it was read, and what was done to it. With ``--dry-run`` print an estimate instead.

    ``has_levels``: the user gave the number of levels.
    """
    from gsmerge.blocks.partition import gaussians_at_once
    from gsmerge.io.formats.table import estimate_counts
    from gsmerge.io.formats.write import level_output
    from gsmerge.plan.blocks import wanted_blocks
    from gsmerge.results.outputs import name_outputs, settings_for
    from gsmerge.runtime.memory import memory_bytes, memory_problem

    reading = opt.read_hints(hint)
    engine = settings.blocks.engine.engine
    if engine == "ray" and not run.dry_run:
        from gsmerge.runtime.work import require_ray

        require_ray()
    outputs = name_outputs(run.out, writing, overwrite=run.overwrite)
    settings = settings_for(outputs, settings, has_levels=has_levels)
    # Results in several formats share a camera file, which may exist already, unless --overwrite replaces it
    replaced_cameras = outputs.viewer_cameras if outputs.overwrite else None
    num_files = settings.budget.levels if outputs.format.levels == "apart" else 1
    written = [*outputs.paths, *(level_output(run.out, level) for level in range(1, num_files)), replaced_cameras]
    networks = [] if settings.checkpoint in CHECKPOINTS else [Path(settings.checkpoint)]
    check_outputs(written, (*input_files(files), *networks), overwrite=run.overwrite or run.dry_run)
    if run.dry_run:
        from gsmerge.jobs.estimate import dry_run_lines, estimate_files
        from gsmerge.reading.input import read_input

        load = read_input(files, opacity=reading.opacity, hints=reading.hints)
        _print_candidates(load.candidates, run)
        with opt.usage_errors():
            estimate = estimate_files(load, settings, outputs)
        print_document(estimate, dry_run_lines(estimate), as_json=run.json)
        return None, []
    # Warn before reading if the scene, or the largest of its blocks, is not likely to fit into memory
    count, num_rest = estimate_counts([ply for scene_files in (files, *files.more) for ply in scene_files.plys])
    at_once = gaussians_at_once(count, wanted_blocks(settings, count))
    problem = memory_problem(memory_bytes(at_once, num_rest=num_rest, num_elsewhere=count - at_once))
    if problem is not None:
        say(problem, kind="warning", quiet=run.silent)
    from gsmerge.run import compact_files

    loads: list[Loaded] = []
    seconds_before = {"import": perf_counter() - run.start}
    with separate_stdout(engine, quiet=run.silent), stage_progress(quiet=run.silent) as progress:
        document = compact_files(
            files, settings, outputs, opacity=reading.opacity, hints=reading.hints, progress=progress,
            hashed=run.json, seconds_before=seconds_before, on_read=loads.append,
        )  # fmt: skip
    _print_candidates(loads[0].candidates, run)
    changes = document["choices"].get("changes", [])
    for change in changes:
        say(f"changed: {change}", quiet=run.silent)
    _print_result(document, run)
    return loads[0], changes


def _print_candidates(candidates: "Sequence[Choice]", run: Run) -> None:
    """With ``--verbose``, print which cameras, photos and masks were tried, and why they are used or left out."""
    from gsmerge.reading.choice import candidate_lines

    for line in candidate_lines([asdict(choice) for choice in candidates]) if run.verbose else ():
        say(line, quiet=run.quiet)


def _show_page(
    on_page: Sequence[Path], loaded: "Loaded | None", changes: Sequence[str], run: Run, *, open: bool
) -> None:
    """Show the result on a page, beside the scene that was ``loaded`` if ``on_page`` has both, and its ``changes``."""
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
        is_opened = open and not run.json
        show_page(loaded.files, after, loaded=loaded, changes=changes, open=is_opened, quiet=run.silent)


def _print_result(document: Mapping[str, Any], run: Run) -> None:
    """Print the report of a run and, unless a page will show the result, how to view it.

    Warns of a result that is worse than its input. Raises TargetError for a missed target or, with ``--strict``, a
    doubt.
    """
    from gsmerge.io.formats.table import VIEWED
    from gsmerge.results.report import result_table

    notes = split_notes(document["notes"], "worse")[1]  # that it is worse is printed after the report
    say_notes([note for note in notes if not (run.strict and isinstance(note, Doubt))], quiet=run.silent)
    columns = terminal_columns(sys.stdout)
    next_step = None
    if columns is not None and not run.has_page and run.out.suffix.lower() in VIEWED:
        # ./ before a path that begins with a dash shows that the path is not an option
        paths = [f"./{path}" if str(path)[0] == "-" else str(path) for path in (run.scene, run.out)]
        next_step = shlex.join(["gsmerge", "view", *paths])
    lines = result_table(document, next_step, columns=columns)
    print_document(document, lines, as_json=run.json, quiet=run.quiet, wrap=False)
    psnr = document["psnr_input_views"]
    worse = document["worse"]
    keeps_fidelity = "fidelity" in document["choices"]
    if run.strict and not (worse or keeps_fidelity) and psnr["before"] is None:
        say_notes(["--strict: nothing was checked, since there is no photo to compare with"], quiet=run.silent)
    if worse and not run.strict:
        has_loss = keeps_fidelity or (psnr["after"] is not None and psnr["after"] < psnr["before"])
        say(f"{worse}; {REMEDY}" if has_loss else worse, kind="warning", quiet=run.silent)
    problems = [document["unmet"], *(document["doubts"] if run.strict else [])]
    if any(problems):
        raise TargetError("; ".join(filter(None, problems)))


def _decode_features(context: typer.Context, path: Path, given: opt.Given, run: Run) -> None:
    """Decode the Feature Gaussians of a ``.gsm``, and write the result; UsageError for an option that needs a scene."""
    from gsmerge.jobs.states.files import decode_file, decoding_line
    from gsmerge.results.outputs import name_outputs
    from gsmerge.settings.stages import DecodeOptions

    for name, value in context.params.items():
        if value not in (None, False, [], ()) and name not in FEATURE_OPTIONS:
            flag = f"--{name.replace('_', '-')}"
            problem = f"expected a scene with it, but {path} holds Feature Gaussians; their number is set by --k"
            raise UsageError(f"{flag}: {problem}")
    decoding, writing = given.make(DecodeOptions, FileOptions, columns="needed")
    outputs = name_outputs(run.out, writing, overwrite=run.overwrite)
    check_outputs(outputs.paths, (path,), overwrite=run.overwrite or run.dry_run)
    before = {"import": perf_counter() - run.start}
    document = decode_file(path, outputs, decoding, dry_run=run.dry_run, seconds_before=before)
    say_notes(document["notes"], quiet=run.silent)
    print_document(document, decoding_line(document), as_json=run.json, quiet=run.quiet and not run.dry_run)


def _find_files(scenes: Sequence[Path], output: Path | None, cameras: Any, **named: Any) -> "SceneFiles":
    """Find the files of a scene, and of further scenes to join with it: those named, or those beside each scene.

    Raises UsageError for several scenes if ``--cameras`` names one file for all, or if a scene is given twice or is a
    result, and SceneError if one is missing.
    """
    from gsmerge.io.formats.ply import header_content
    from gsmerge.reading.scene_files import find_scene_files

    if len(scenes) > 1 and cameras not in (None, NONE):
        problem = "--cameras: expected one scene with it, got several"
        raise UsageError(f"{problem}; the cameras of several scenes are read from beside or inside them")
    advice = "" if output else "name the output with -o"
    remedy = f"; {advice}" if advice else ""
    for i, scene in enumerate(scenes if len(scenes) > 1 else ()):
        if not os.path.lexists(scene):
            raise SceneError(scene, "no such file", advice)
        if any(os.path.realpath(scene) == os.path.realpath(other) for other in scenes[:i]):
            raise UsageError(f"{scene}: expected each scene once, got it twice{remedy}")
        if scene.is_file() and header_content(scene) == "result":
            raise UsageError(f"{scene}: expected scenes to join, found a result of gsmerge{remedy}")
    files, *more = (find_scene_files(path, cameras=cameras, **named) for path in scenes)
    return replace(files, more=tuple(more))
