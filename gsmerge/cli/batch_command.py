"""``gsmerge batch``: many scenes, each on its own."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from contextlib import closing
from typing import TYPE_CHECKING, TextIO

import typer

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import (
    duration,
    one_line,
    print_document,
    say,
    say_notes,
    say_warning,
    separate_stdout,
    total_progress,
)
from gsmerge.errors import BatchError, SceneError, TargetError, UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from gsmerge.batch import BatchOptions, Job
    from gsmerge.batch.records import RecordIndex, Totals
    from gsmerge.batch.schedule import Schedule


def parse_jobs(text: str) -> int:
    """Parse ``--jobs``: a number, or "auto", which gives 0."""
    if text == "auto":
        return 0
    if not text.isdecimal() or int(text) < 1:
        raise typer.BadParameter(f'expected a number from 1 or "auto", got {text!r}')
    return int(text)


@opt.command(
    opt.argument("scenes", list[str], "FOLDER|PATTERN|LIST...", "Folders to search for scenes, patterns, .ply files, "
                 "or text files with one of these per line."),
    *opt.panel(
        opt.INPUT,
        opt.option("cameras", str, "Cameras: one path for all scenes, or with {scene}, {parent} and {stem} of each in "
                   "it.", wording="beside each"),
        opt.option("images", str, "Folder of the photos, in the same way.", wording="beside each"),
    ),
    "hint k superpixels budget quality effort fit set",
    *opt.panel(
        "Running",
        opt.option("jobs", str, "Scenes at once: a number, or auto.", wording="auto", parser=parse_jobs,
                   metavar="N|auto"),
        opt.option("max_memory", str, "Memory that all scenes at once may take, such as 8GB.",
                   wording="most of the free memory"),
        opt.option("timeout", float, "Seconds that a scene may take.", min=0.001),
        opt.option("retries", int, "How often a scene is tried again whose process died or took too long.", default=1,
                   min=0),
    ),
    "engine address",
    opt.output("Folder for the results; scenes whose result it holds are skipped.", default=opt.REQUIRED),
    *opt.panel(
        opt.OUTPUT,
        opt.option("name", str, "Name of a result: {stem}, {parent}, {index} and {k} are filled in.",
                   default="{stem}.ply", metavar="NAME"),
        opt.option("resume", bool, "Skip scenes that are done, or do them again.", "--resume/--rerun", default=True,
                   wording="--resume"),
    ),
    opt.changed("overwrite", False, help="Replace files in the folder that no batch wrote."),
    "strict dry_run seed",
    opt.changed("threads", help="Threads of each scene.", show_default="processors by jobs"),
    opt.changed("json", False, help="Print one line of JSON per scene on stdout."),
    rare="hint fit seed threads quiet",
)  # fmt: skip
def batch(args: opt.Args) -> None:
    """Compact many scenes, each on its own: a failure stops no other scene, and a second call continues."""
    out = args.output
    if out.exists() and not out.is_dir():
        raise UsageError(f"--output: expected a folder, found the file {out}")
    hints = args.hints()
    from gsmerge.batch import BatchOptions, find_jobs
    from gsmerge.batch.records import MAX_LISTED, RecordIndex
    from gsmerge.batch.schedule import make_schedule

    with opt.usage_errors():
        options = BatchOptions(
            args.settings(), args.opacity, hints, args.cameras, args.images, args.name, args.jobs or None,
            _bytes(args.max_memory), args.timeout, args.retries, rerun=not args.resume, overwrite=args.overwrite,
            engine=args.engine, address=args.address,
        )  # fmt: skip
    if options.engine == "ray" and not args.dry_run:
        from gsmerge.runtime.work import require_ray

        require_ray()
    index = RecordIndex(out)
    index.read_on()
    unreadable: list[SceneError] = []
    jobs = find_jobs(args.scenes, out, options, index.result_paths(), unreadable)
    schedule = make_schedule(jobs, options)
    damaged = [f"{index.damaged} damaged line(s) of the records were ignored"] if index.damaged else []
    notes = [*damaged, *schedule.notes, *(f"passed by: {error}" for error in unreadable[:MAX_LISTED])]
    if args.dry_run:
        print_plan(args, jobs, options, index, schedule, notes)
        return
    say_notes(notes, quiet=args.silent)
    _run(args, jobs, options, index, schedule)
    if unreadable:
        raise BatchError(f"{len(unreadable)} folder(s) were passed by; the first: {unreadable[0]}")


def _bytes(text: str | None) -> int | None:
    from gsmerge.settings.budget import parse_bytes

    try:
        return None if text is None else parse_bytes(text)
    except ValueError:
        raise UsageError(f'--max-memory: expected a size such as 8GB, got "{text}"') from None


def _run(args: opt.Args, jobs: Sequence[Job], options: BatchOptions, index: RecordIndex, schedule: Schedule) -> None:
    """Compact all scenes, report each, and sum up."""
    from gsmerge.batch.records import Totals, summary_lines, write_summary

    totals, out = Totals(len(jobs)), args.output
    at_once = f"{schedule.jobs or 'all it has room for'} at once, {schedule.threads} thread(s) each"
    say(f"{len(jobs):,} scenes, {at_once}", quiet=args.silent)
    interrupted = False
    try:
        run_jobs(args, totals, jobs, options, index, schedule, sys.stdout if args.json else None)
    except KeyboardInterrupt:
        interrupted = True
        raise
    finally:
        if totals.ended or interrupted:
            path = write_summary(out)
            if not args.silent:
                print("\n".join(map(one_line, summary_lines(totals, path))))
    worse = ""
    if totals.worse:
        worse = f"{totals.num_worse} of {totals.total} results show their photos worse than the input"
        worse += _first(totals.worse, listed=not args.silent)
    if worse and not args.strict:
        say_warning(worse, quiet=args.silent)
    check_failures(totals, "scenes", listed=not args.silent)
    if totals.unmet:
        raise TargetError(f"{totals.unmet} of {totals.total} results miss the target")
    if worse and args.strict:
        raise TargetError(worse)


def run_jobs(
    args: opt.Args,
    totals: Totals,
    jobs: Sequence[Job],
    options: BatchOptions,
    index: RecordIndex,
    schedule: Schedule,
    lines: TextIO | None = None,
) -> None:
    """Run jobs, show progress, count results in ``totals``, and print records as JSON to ``lines``."""
    from gsmerge.batch import run_batch

    with (
        separate_stdout(options.engine, quiet=args.silent),
        closing(run_batch(jobs, args.output, options, index=index, schedule=schedule)) as records,
        total_progress(totals.total, quiet=args.silent) as progress,
    ):
        for record in records:
            totals.add(record)
            if lines is not None:
                print(json.dumps(record, separators=(",", ":")), file=lines, flush=True)
            why, num_failed = record["error"] or "", totals.counts["failed"]
            failed = f", {num_failed} failed" if num_failed and not why else ""
            progress(f"{record[totals.name]} {record['status']}{failed}", totals.ended, why)


def check_failures(totals: Totals, unit: str, *, listed: bool = False) -> None:
    """Raise BatchError if a job failed, with the first reason unless the failures were ``listed``."""
    num_failed = totals.counts["failed"]
    if num_failed:
        raise BatchError(f"{num_failed} of {totals.total} {unit} failed{_first(totals.failures, listed=listed)}")


def _first(reasons: Sequence[tuple[str, str]], *, listed: bool) -> str:
    scene, why = reasons[0]
    return "" if listed else f"; the first: {scene}: {why}"


def pending_jobs(jobs: Sequence[Job], out: Path, options: BatchOptions, index: RecordIndex) -> list[Job]:
    """List the jobs without an up-to-date result in the folder; all jobs if results are to be made again."""
    from gsmerge.batch.task import BatchContext, Task, is_done

    known = {} if options.rerun else index.known
    shared = BatchContext(out, options, 0)
    return [job for job in jobs if not is_done(Task(job, known.get(job.output)), shared)]


def print_plan(
    args: opt.Args,
    jobs: Sequence[Job],
    options: BatchOptions,
    index: RecordIndex,
    schedule: Schedule,
    notes: Sequence[str],
    unit: str = "scenes",
) -> None:
    """Print what a run would do and how long it would take; ``unit``: word for the jobs."""
    from gsmerge.batch.schedule import estimate_seconds
    from gsmerge.report import document_head, human_bytes

    out, pending = args.output, pending_jobs(jobs, args.output, options, index)
    left = {job.output for job in pending}
    seconds = estimate_seconds(pending, options, schedule)
    document = {
        **document_head(),
        "dry_run": True,
        "output": str(out),
        f"num_{unit}": len(jobs),
        "num_pending": len(pending),
        "jobs": schedule.jobs,
        "threads": schedule.threads,
        "estimate": {"seconds": round(seconds, 1), "memory_bytes": schedule.memory},
        unit: [
            {"scene": j.scene, "output": j.output, "num_gaussians": j.num_gaussians, "done": j.output not in left}
            for j in jobs
        ],
        "options": options.result_settings()["settings"],
        "notes": list(notes),
    }
    lines = [f"{job.scene} -> {out / job.output}" for job in pending]
    lines += [f"note: {note}" for note in notes]
    lines.append(f"would write {out}: {len(pending):,} of {len(jobs):,} {unit} to do")
    lines.append(
        f"at once     {schedule.jobs or 'as many as the cluster has room for'}, {schedule.threads} thread(s) each"
    )
    lines.append(f"estimate    about {duration(seconds)}, {human_bytes(schedule.memory)} of memory")
    print_document(document, lines, as_json=args.json)
