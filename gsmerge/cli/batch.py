"""``gsmerge batch``: many scenes, each on its own."""

from __future__ import annotations

import json as json_lines
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, redirect_stdout
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO

import typer

from gsmerge.cli import network_options as net
from gsmerge.cli import options as opt
from gsmerge.cli.console import duration, one_line, say, say_notes, total_progress
from gsmerge.cli.settings import given_settings, reading_of, told_as_usage
from gsmerge.errors import BatchError, TargetError, UsageError

if TYPE_CHECKING:
    from gsmerge.batch import BatchOptions, Job
    from gsmerge.batch.plan import Schedule
    from gsmerge.batch.records import RecordIndex
    from gsmerge.batch.summary import Totals

RUNNING = "Running"


class Engine(str, Enum):
    """Where scenes are worked on."""

    local = "local"
    ray = "ray"


def parse_jobs(text: str) -> int:
    """``--jobs``: a number, or auto (0)."""
    if text == "auto":
        return 0
    if not text.isdecimal() or int(text) < 1:
        raise typer.BadParameter(f'expected a number from 1 or "auto", got {text!r}')
    return int(text)


def _option(help: str, *names: str, panel: str = RUNNING, **settings: Any) -> Any:
    return typer.Option(*names, help=help, rich_help_panel=panel, **settings)


Scenes = Annotated[
    list[str],
    typer.Argument(
        metavar="FOLDER|PATTERN|LIST...",
        help="Folders to search for scenes, patterns, .ply files, or text files with one of these per line.",
    ),
]
Cameras = Annotated[
    str | None,
    _option(
        "Cameras: one path for all scenes, or with {scene}, {parent} and {stem} of each in it.",
        show_default="found beside each",
        panel=opt.INPUT,
    ),
]
Images = Annotated[str | None, _option("Folder of the photos, in the same way.", show_default="found", panel=opt.INPUT)]
Out = Annotated[Path, _option("Folder for the results; what it has already is skipped.", panel=opt.OUTPUT)]
Output = Annotated[
    str,
    _option("Name of a result: {stem}, {parent}, {index} and {k} are filled in.", metavar="NAME", panel=opt.OUTPUT),
]
Jobs = Annotated[
    str | None,
    _option("Scenes at once: a number, or auto.", "--jobs", parser=parse_jobs, metavar="N|auto", show_default="auto"),
]
MaxMemory = Annotated[
    str | None, _option("Memory that they may take together, such as 8GB.", show_default="most of what is free")
]
Timeout = Annotated[float | None, _option("Seconds that a scene may take.", min=0.001)]
Retries = Annotated[int, _option("How often a scene is tried again whose process died or took too long.", min=0)]
EngineChoice = Annotated[Engine, _option("local: processes on this machine; ray: a Ray cluster, gsmerge[ray].")]
Address = Annotated[
    str | None, _option("Of the Ray cluster, such as auto or HOST:PORT.", show_default="one of this machine")
]
Resume = Annotated[
    bool, _option("Skip what is done, or do it again.", "--resume/--rerun", panel=opt.OUTPUT, show_default="--resume")
]


def batch(
    context: typer.Context,
    scenes: Scenes,
    out: Out,
    output: Output = "{stem}.ply",
    jobs: Jobs = None,
    max_memory: MaxMemory = None,
    timeout: Timeout = None,
    retries: Retries = 1,
    engine: EngineChoice = Engine.local,
    address: Address = None,
    resume: Resume = True,
    cameras: Cameras = None,
    images: Images = None,
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
    seed: opt.SeedOption = None,
    threads: Annotated[
        int | None, _option("Threads of each scene.", min=1, show_default="processors by jobs", panel=opt.OUTPUT)
    ] = None,
    overwrite: Annotated[
        bool, _option("Replace files in the folder that no batch wrote.", "--overwrite", panel=opt.OUTPUT)
    ] = False,
    json: Annotated[bool, _option("Print one line of JSON per scene on stdout.", "--json", panel=opt.OUTPUT)] = False,
    dry_run: opt.DryRunOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Compact many scenes, each on its own: what fails stops nothing else, what is done is not done again."""
    if out.exists() and not out.is_dir():
        raise UsageError(f"--out: expected a folder, found the file {out}")
    hints = reading_of(exporter, quats.value, order.value, scene_scale, max_side)
    from gsmerge.batch import BatchOptions, find_jobs
    from gsmerge.batch.plan import make_schedule
    from gsmerge.batch.records import RecordIndex

    names = ("output", "timeout", "retries", "address", "cameras", "images", "overwrite")
    given = {name: context.params[name] for name in names} | {"jobs": context.params["jobs"] or None}
    with told_as_usage():
        options = BatchOptions(
            given_settings(context.params), opacity.value, hints, max_memory=_bytes(max_memory), rerun=not resume,
            engine=engine.value, **given,
        )  # fmt: skip
    if options.engine == "ray" and not dry_run:
        from gsmerge.batch.ray_engine import require_ray

        require_ray()
    index = RecordIndex(out)
    index.read_on()
    found = find_jobs(scenes, out, options, index.result_paths())
    schedule = make_schedule(found, options)
    if dry_run:
        _print_plan(found, out, options, index, schedule, as_json=json)
        return
    say_notes(_notes(index, schedule), quiet=quiet or json)
    _run(found, out, options, index, schedule, as_json=json, quiet=quiet)


def _bytes(text: str | None) -> int | None:
    from gsmerge.budget import parse_bytes

    try:
        return None if text is None else parse_bytes(text)
    except ValueError:
        raise UsageError(f'--max-memory: expected a size such as 8GB, got "{text}"') from None


def _notes(index: RecordIndex, schedule: Schedule) -> list[str]:
    damaged = [f"{index.damaged} damaged line(s) of the records were passed over"] if index.damaged else []
    return [*damaged, *schedule.notes]


def _run(
    found: Sequence[Job],
    out: Path,
    options: BatchOptions,
    index: RecordIndex,
    schedule: Schedule,
    *,
    as_json: bool,
    quiet: bool,
) -> None:
    """Work, tell, sum up.

    Raises:
        BatchError: If a scene failed.
        TargetError: If none did, and a result misses its target.
    """
    from gsmerge.batch import run_batch
    from gsmerge.batch.summary import Totals, summary_lines, write_summary

    totals, path = Totals(len(found)), None
    silent = quiet or as_json
    spread = f"{schedule.jobs or 'all it has room for'} at once, {schedule.threads} thread(s) each"
    say(f"{len(found):,} scenes, {spread}", quiet=silent)
    interrupted = False
    try:
        lines = sys.stdout
        with (
            _apart(options, quiet=silent),
            closing(run_batch(found, out, options, index=index, schedule=schedule)) as records,
        ):
            _follow(records, totals, lines if as_json else None, quiet=silent)
    except KeyboardInterrupt:
        interrupted = True
        raise
    finally:
        if totals.ended or interrupted:
            path = write_summary(out)
            if not silent:
                print("\n".join(map(one_line, summary_lines(totals, path))))
    failed = totals.counts["failed"]
    if failed:
        scene, why = totals.failures[0]
        raise BatchError(f"{failed} of {totals.total} scenes failed; the first: {scene}: {why}")
    if totals.unmet:
        raise TargetError(f"{totals.unmet} of {totals.total} results miss the target")


@contextmanager
def _apart(options: BatchOptions, *, quiet: bool) -> Iterator[None]:
    """A block in which Ray, which tells on stdout of processes that were lost, does not mix with our lines."""
    if options.engine != "ray":
        yield
        return
    with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stdout(nowhere if quiet else sys.stderr):
        yield


def _follow(records: Iterable[dict[str, Any]], totals: Totals, lines: TextIO | None, *, quiet: bool) -> None:
    """Tell of every scene as it ends."""
    with total_progress(totals.total, quiet=quiet) as progress:
        for record in records:
            totals.add(record)
            if lines is not None:
                print(json_lines.dumps(record, separators=(",", ":")), file=lines, flush=True)
            failed = f", {totals.counts['failed']} failed" if totals.counts["failed"] else ""
            why = f": {record['error']}" if record["error"] else ""
            progress(f"{record['scene']} {record['status']}{why}{failed}", totals.ended, totals.total)


def _print_plan(
    found: Sequence[Job], out: Path, options: BatchOptions, index: RecordIndex, schedule: Schedule, *, as_json: bool
) -> None:
    from gsmerge.batch.plan import estimate_seconds
    from gsmerge.batch.task import BatchContext, is_done
    from gsmerge.report import document_head, human_bytes, to_json

    shared = BatchContext(out, options, 0)
    done = set()
    if not options.rerun:
        done = {job.output for job in found if (known := index.known.get(job.output)) and is_done(job, known, shared)}
    pending = [job for job in found if job.output not in done]
    seconds = estimate_seconds(pending, options, schedule)
    notes = _notes(index, schedule)
    if as_json:
        document = {
            **document_head(),
            "dry_run": True,
            "output": str(out),
            "num_scenes": len(found),
            "num_pending": len(pending),
            "jobs": schedule.jobs,
            "threads": schedule.threads,
            "estimate": {"seconds": round(seconds, 1), "memory_bytes": schedule.memory},
            "scenes": [
                {
                    "scene": job.scene,
                    "output": job.output,
                    "num_gaussians": job.num_gaussians,
                    "done": job.output in done,
                }
                for job in found
            ],
            "options": options.result_settings()["settings"],
            "notes": notes,
        }
        sys.stdout.write(to_json(document))
        return
    lines = [f"{job.scene} -> {out / job.output}" for job in pending]
    lines += [f"note: {note}" for note in notes]
    lines.append(f"would write {out}: {len(pending):,} of {len(found):,} scenes to do")
    lines.append(
        f"at once     {schedule.jobs or 'as many as the cluster has room for'}, {schedule.threads} thread(s) each"
    )
    lines.append(f"estimate    about {duration(seconds)}, {human_bytes(schedule.memory)} of memory")
    print("\n".join(map(one_line, lines)))
