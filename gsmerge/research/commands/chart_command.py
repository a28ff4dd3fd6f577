"""``gsmerge lab chart``: run a grid of settings, and make charts and a page of the results."""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsmerge.cli import parameters as opt
from gsmerge.cli.batch_command import check_failures, print_plan, run_jobs
from gsmerge.cli.before_after import lpips_networks
from gsmerge.cli.console import print_document, say_notes
from gsmerge.cli.paths import write_texts
from gsmerge.errors import UsageError
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.evaluate import NETS
from gsmerge.settings.setting import Settings, flat_settings, setting

if TYPE_CHECKING:
    from gsmerge.batch import BatchOptions, Job

CHARTS, PAGE, TABLE = "charts", "index.html", "runs.csv"  # in the folder


@dataclass(frozen=True)
class ChartOptions(Settings):
    """Settings of a grid's measurements."""

    target_images: str | None = setting(None, "Folder of the held-out photos, as `--targets` names their cameras.")
    photo_side: int = setting(0, "Resize larger photos to so many pixels on the longer side; 0: not.", least=0)
    lpips: str | None = setting(None, "Networks of LPIPS; by default those installed.", choices=("both", *NETS, "none"))
    lpips_views: int = setting(2, "Measure LPIPS on at most so many views of each split.", least=1)
    rerun: bool = setting(False, "Repeat runs that are done.")


@opt.command(
    opt.argument("scenes", list[str] | None, "[SCENE]...", "Folders to search for scenes, patterns, .ply files, or "
                 "text files with one of these per line. None: draw the results in the folder.", default=None),
    *opt.panel(
        "Runs",
        opt.option("grid", list[str], "Values to run, in every combination, such as budget=1%,4% or "
                   "method=gsmerge,voxel; also of k, superpixels, segmentation, fit, effort, match and views; may be "
                   "repeated.", metavar="NAME=A,B"),
    ),
    opt.settings_option(CompactOptions, ChartOptions, example="lpips=none"),
    *opt.panel(
        opt.INPUT,
        opt.option("targets", str, "Cameras of held-out photos: one file, or with {scene}, {parent} and {stem} of each "
                   "scene in it."),
    ),
    opt.output("Folder for the results; runs that it holds are not repeated.", default=Path("charts")),
    "dry_run",
)  # fmt: skip
def chart(args: opt.Args) -> None:
    """Run settings over scenes, and draw charts and a page of all results; a repeated call resumes the runs."""
    scenes, out = args.scenes or [], args.output
    if os.path.lexists(out) and not out.is_dir():
        raise UsageError(f"--output: expected a folder, found the file {out}")
    if not scenes:
        if args.dry_run:
            raise UsageError("--dry-run: expected scenes to run, got none")
        _draw(args, [], 0)
        return
    from gsmerge.batch.run import pending_jobs

    jobs, options, notes = _make_jobs(args, scenes)
    if args.dry_run:
        print_plan(args, jobs, options, "runs", notes)
        return
    say_notes(notes, quiet=args.silent)
    pending, failed = [job for job, _ in pending_jobs(jobs, out, options)], list[tuple[str, str]]()

    def add(record: dict[str, Any]) -> None:
        if record["error"] is not None:
            failed.append((record["output"], record["error"]))

    if pending:
        run_jobs(args, pending, options, add, "output")
    _draw(args, notes, len(pending))
    check_failures(failed, len(pending), "runs")


def _make_jobs(args: opt.Args, scenes: Sequence[str]) -> tuple[list[Job], BatchOptions, list[str]]:
    """Make the jobs of the grid, the options of their batch, and notes."""
    from gsmerge.batch import BatchOptions
    from gsmerge.measure.evaluate import EvaluateOptions
    from gsmerge.research.charts.grid import find_sources, make_jobs, parse_grid

    fixed = args.values(CompactOptions, ChartOptions)
    with opt.usage_errors():
        own = ChartOptions(**{name: fixed.pop(name) for name in flat_settings(ChartOptions) if name in fixed})
    run: dict[str, Any] = {name: fixed.pop(name) for name in ("seed", "threads") if name in fixed}
    nets, notes = lpips_networks(own.lpips, NETS)
    grid = parse_grid(args.grid or (), fixed)
    with opt.usage_errors():
        measured = EvaluateOptions(nets, own.lpips_views, photo_side=own.photo_side)
        settings = CompactOptions().with_settings(run)
        options = BatchOptions(settings, jobs=1, overwrite=own.rerun)  # one job, so that no run slows another one
    sources = find_sources(scenes, args.output, args.targets, own.target_images)
    words = ["gsmerge", "lab", "chart", *scenes, "--output", str(args.output)]  # the equivalent command line
    for name, value in args.given(("grid", "set", "targets")).items():
        for element in value if isinstance(value, list) else [value]:
            words += [f"--{name}", element]
    jobs, left_out = make_jobs(sources, grid, measured, seed=settings.seed, command=shlex.join(words))
    return jobs, options, [*notes, *left_out]


def _draw(args: opt.Args, notes: Sequence[str], num_done: int) -> None:
    """Draw charts, page and table of all runs in the folder, and print a summary; ``notes`` were printed before."""
    from gsmerge.report import document_head
    from gsmerge.research.charts.chart_page import make_page, make_table
    from gsmerge.research.charts.figures import draw_figures, make_figures
    from gsmerge.research.charts.lines import Results
    from gsmerge.research.charts.measure_run import list_held_out_notes, read_runs

    out = args.output
    records, more = read_runs(out)
    if not records:
        raise UsageError(f"{out}: expected finished runs, found none; name scenes to run")
    say_notes([*more, *list_held_out_notes(records)], quiet=args.silent)
    figures = make_figures(Results(records))
    drawings = draw_figures(figures, out / CHARTS)
    command = shlex.join(["gsmerge", "lab", "chart", "--output", str(out)])
    page = make_page(records, figures, drawings, out, command)
    write_texts({out / PAGE: page, out / TABLE: make_table(records)}, overwrite=True)
    failed = sum(record.error is not None for record in records)
    document = {
        **document_head(),
        "output": str(out),
        "page": str(out / PAGE),
        "charts": [str(out / CHARTS / f"{figure.name}.{suffix}") for figure in figures for suffix in ("png", "svg")],
        "num_runs": len(records),
        "num_done": num_done,
        "num_failed": failed,
        "runs": [record.to_dict() for record in records],
        "notes": [*notes, *more],
    }
    line = f"{out / PAGE}: {len(records)} runs ({num_done} new{f', {failed} failed' if failed else ''}),"
    print_document(document, f"{line} {len(figures)} charts", as_json=args.json, quiet=args.quiet)
