"""``gsmerge lab chart``: run a grid of settings, and make charts and a page of the results."""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsmerge.cli import parameters as opt
from gsmerge.cli.batch_command import check_failures
from gsmerge.cli.before_after import lpips_networks
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.cli.paths import write_texts
from gsmerge.errors import UsageError
from gsmerge.measure.documents import document_head, note_entries
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.evaluate import NETS
from gsmerge.settings.setting import Settings, flat_settings, setting

if TYPE_CHECKING:
    from gsmerge.measure.evaluate import EvaluateOptions
    from gsmerge.research.charts.grid import GridRun

CHARTS, PAGE, TABLE = "charts", "index.html", "runs.csv"  # a folder and two files in the output folder


@dataclass(frozen=True)
class ChartOptions(Settings):
    """Settings of a grid's measurements."""

    lpips: str | None = setting(None, "Networks of LPIPS; by default those installed.", choices=("both", *NETS, "none"))
    lpips_views: int = setting(2, "Measure LPIPS on at most so many views of each split.", least=1)
    rerun: bool = setting(False, "Repeat runs that are done.")


@opt.command(
    opt.argument("scenes", list[str] | None, "[SCENE]...", "Folders to search for scenes, patterns, .ply files, or "
                 "text files with one of these per line. None: draw the results in the folder.", default=None),
    *opt.panel(
        "Runs",
        opt.option("grid", list[str], "Values of a setting to run, in every combination with those of others, such as "
                   "budget=1%,4% or method=gsmerge,random; may be repeated.", metavar="NAME=A,B"),
    ),
    opt.settings_option(CompactOptions, ChartOptions, example="lpips=none"),
    *opt.panel(
        opt.INPUT_GROUP,
        opt.option("targets", str, "Cameras of held-out photos: one file, or with {scene}, {parent} and {stem} of each "
                   "scene in it."),
    ),
    opt.output("Folder for the results; runs that it holds are not repeated.", default=Path("charts")),
    "dry_run",
)  # fmt: skip
def chart(args: opt.Args) -> None:
    """Run settings over scenes, and draw charts and a page of all results; a repeated call resumes the runs."""
    from gsmerge.research.charts.measure_run import read_runs

    scenes, out = args.scenes or [], args.output
    if os.path.lexists(out) and not out.is_dir():
        raise UsageError(f"--output: expected a folder, found the file {out}")
    if not scenes and args.dry_run:
        raise UsageError("--dry-run: expected scenes to run, got none")
    fixed = args.values(CompactOptions, ChartOptions)
    with opt.usage_errors():
        chart_options = ChartOptions(**{name: fixed.pop(name) for name in flat_settings(ChartOptions) if name in fixed})
    measured, runs, notes = _plan_runs(args, scenes, chart_options, fixed)
    done = {record.key for record in read_runs(out) if record.error is None and not chart_options.rerun}
    pending = [run for run in runs if run[1].key not in done]
    if args.dry_run:
        labels = [f"{source.path} -> {out}: {record.label}" for source, record, _ in pending]
        line = f"{out}: {len(pending)} of {len(runs)} runs"
        document = {"runs": labels, "num_runs": len(runs), **note_entries(notes)}
        print_document(document, [*labels, line], as_json=args.json, quiet=args.quiet)
        return
    say_notes(notes, quiet=args.silent)
    failed = _run_all(args, pending, measured)
    _draw_results(args, notes, len(pending))
    check_failures(failed, len(pending), "run")


def _plan_runs(
    args: opt.Args, scenes: Sequence[str], chart_options: ChartOptions, fixed: dict[str, Any]
) -> tuple[EvaluateOptions, list[GridRun], list[str]]:
    """Return the options with which results are measured, the runs of the grid, and notes for the user.

    ``fixed`` are settings of compact that hold for all runs.
    """
    from gsmerge.measure.evaluate import EvaluateOptions
    from gsmerge.research.charts.grid import find_sources, make_runs, parse_grid

    nets, notes = lpips_networks(chart_options.lpips, NETS) if scenes else ((), [])
    measured, grid = EvaluateOptions(nets, chart_options.lpips_views), parse_grid(args.grid or ())
    sources = find_sources(scenes, args.output, args.targets) if scenes else []
    return measured, make_runs(sources, grid, fixed, measured), list(notes)


def _run_all(args: opt.Args, runs: Sequence[GridRun], measured: EvaluateOptions) -> list[tuple[str, str]]:
    """Do all runs, and append a record of each to the folder. Returns the name and the error of each failed run."""
    from gsmerge.io.jsonl import append_line
    from gsmerge.research.charts.measure_run import RUNS, run_setting

    failed = []
    with stage_progress(quiet=args.silent) as progress:
        for i, (source, record, options) in enumerate(runs):
            name = f"{source.name}/{record.label}"
            progress(name, i, len(runs))
            try:
                finished = run_setting(source, record, options, measured)
            except Exception as error:  # a run that fails does not end the others
                finished = replace(record, error=" ".join(f"{type(error).__name__}: {error}".split()))
                failed.append((name, str(finished.error)))
            append_line(args.output / RUNS, asdict(finished))
    return failed


def _draw_results(args: opt.Args, notes: Sequence[str], num_done: int) -> None:
    """Draw the charts, page and table of all runs in the folder, and print a summary.

    ``notes`` go into the report; these notes are already printed. ``num_done`` is the number of runs of this call.
    """
    from gsmerge.research.charts.chart_page import list_held_out_notes, make_chart_page, make_table
    from gsmerge.research.charts.figures import draw_figures, make_figures
    from gsmerge.research.charts.lines import Results
    from gsmerge.research.charts.measure_run import read_runs

    out, records = args.output, read_runs(args.output)
    if not records:
        raise UsageError(f"{out}: expected finished runs, found none; name scenes to run")
    say_notes(list_held_out_notes(records), quiet=args.silent)
    figures = make_figures(Results(records))
    drawings = draw_figures(figures, out / CHARTS)
    words = ["gsmerge", "lab", "chart", *(args.scenes or ()), "--output", str(out)]  # the equivalent command line
    for name, value in args.get_given(("grid", "set", "targets")).items():
        for element in value if isinstance(value, list) else [value]:
            words += [f"--{name}", element]
    page = make_chart_page(records, figures, drawings, shlex.join(words))
    write_texts({out / PAGE: page, out / TABLE: make_table(records)})
    failed = sum(record.error is not None for record in records)
    document = {
        **document_head(),
        "output": str(out),
        "page": str(out / PAGE),
        "charts": [str(out / CHARTS / f"{figure.name}.{suffix}") for figure in figures for suffix in ("png", "svg")],
        "num_runs": len(records),
        "num_done": num_done,
        "num_failed": failed,
        "runs": [asdict(record) for record in records],
        **note_entries(notes),
    }
    line = f"{out / PAGE}: {len(records)} runs ({num_done} new{f', {failed} failed' if failed else ''}),"
    print_document(document, f"{line} {len(figures)} charts", as_json=args.json, quiet=args.quiet)
