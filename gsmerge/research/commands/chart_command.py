"""``gsmerge chart``: a grid of runs, charts of them and a page."""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from dataclasses import replace
from inspect import Parameter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsmerge.cli import parameters as opt
from gsmerge.cli.batch_command import check_failures, print_plan, run_jobs
from gsmerge.cli.before_after import lpips_networks
from gsmerge.cli.console import print_document, say_notes
from gsmerge.cli.paths import write_texts
from gsmerge.errors import UsageError

if TYPE_CHECKING:
    from gsmerge.batch import BatchOptions, Job

GRID = "Grid: comma-separated lists, whose product is run"
LISTS = ("methods", "k", "budgets", "superpixels", "segmentations", "fit", "efforts", "matches", "views")
CHARTS, PAGE, TABLE = "charts", "index.html", "runs.csv"  # in the folder


def _list(name: str, help: str, wording: str) -> Parameter:
    return opt.option(name, str, help, wording=wording, metavar="LIST")


@opt.command(
    opt.argument("scenes", list[str] | None, "[SCENE]...", "Folders to search for scenes, patterns, .ply files, or "
                 "text files with one of these per line.", default=None),
    *opt.panel(
        GRID,
        _list("methods", "Methods: gsmerge and baselines.", "gsmerge"),
        _list("k", "Gaussians per superpixel: 1 to 8.", "1"),
        _list("budgets", "Gaussians in the result, such as 0.5%,2%,40000,auto.", "as superpixels and K say"),
        _list("superpixels", "Superpixels per view, such as 3000,4.4%, next to the budgets.", "4.4%"),
        _list("segmentations", "Superpixel methods.", "rdseg"),
        _list("fit", "What is fitted: full, none.", "full"),
        _list("efforts", "Amount of work: fast, default, best.", "default"),
        _list("matches", "Merging across views: overlap, aabb, none.", "overlap"),
        _list("views", "Numbers of input views, evenly spread; all for all.", "all"),
        opt.option("fixed", list[str], "Any other setting of compact for all runs of gsmerge; may be repeated.",
                   metavar="NAME=VALUE"),
        opt.option("grid", Path, "TOML or JSON file with these lists; options win."),
    ),
    "hint",
    *opt.panel(
        opt.INPUT,
        opt.option("targets", str, "Cameras of held-out photos: one file, or with {scene}, {parent} and {stem} of each "
                   "scene in it."),
        opt.option("target_images", str, "Folder of those photos, in the same way."),
    ),
    "photo_side lpips",
    opt.changed("lpips_views", 2, show_default=True),
    *opt.panel(
        opt.MEASURING, opt.option("proxy_views", int, "Photos per scene to measure superpixels on.", default=2, min=0)
    ),
    opt.output("Folder for the results; runs that it holds are not repeated.", default=Path("charts")),
    *opt.panel(
        opt.OUTPUT,
        opt.switch("rerun", "Repeat runs that are done."),
        opt.switch("draw_only", "Draw the results in the folder; run nothing."),
    ),
    f"dry_run {opt.RUN}",
)  # fmt: skip
def chart(args: opt.Args) -> None:
    """Run a grid of settings over scenes, resumable, and draw charts and a page of all results in the folder."""
    scenes, out = args.scenes or [], args.output
    if args.draw_only == bool(scenes):
        raise UsageError("expected scenes to run, or --draw-only without any")
    if args.draw_only and args.dry_run:
        raise UsageError("--dry-run: expected something to run, got --draw-only")
    if os.path.lexists(out) and not out.is_dir():
        raise UsageError(f"--output: expected a folder, found the file {out}")
    if args.draw_only:
        _draw(args, [], 0)
        return
    from gsmerge.batch.workload import pending_jobs

    jobs, options, notes = _make_jobs(args, scenes)
    if args.dry_run:
        print_plan(args, jobs, options, "runs", notes)
        return
    say_notes(notes, quiet=args.silent)
    pending, failed = pending_jobs(jobs, out, options), list[tuple[str, str]]()

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
    from gsmerge.research.charts.grid import Grid, find_sources, make_jobs, parse_grid, read_grid
    from gsmerge.settings.compact import CompactOptions

    nets, notes = lpips_networks(args.lpips)
    base = Grid() if args.grid is None else read_grid(args.grid)
    base = replace(base, fixed=tuple(args.fixed)) if args.fixed else base
    grid = parse_grid({name: getattr(args, name) for name in LISTS}, base)
    with opt.usage_errors():
        measured = EvaluateOptions(nets, args.lpips_views, **args.given(("photo_side",)))
        settings = CompactOptions().with_settings(args.given(("seed", "threads")))
        options = BatchOptions(settings, jobs=1, overwrite=args.rerun)  # so that no run slows another
    sources = find_sources(scenes, args.output, args.targets, args.target_images)
    # the command line that does the same, without options at their defaults
    words = ["gsmerge", "chart", *scenes, "--output", str(args.output)]
    names = [*LISTS, "fixed", "grid", "targets", "target_images", "hint"]
    names += ["photo_side", "lpips", "lpips_views", "proxy_views"]
    for name, value in args.given([*names, "seed", "threads"]).items():
        for element in value if isinstance(value, list) else [value]:
            words += [f"--{name.replace('_', '-')}", str(element)]
    more: dict[str, Any] = {"seed": settings.seed, "proxy_views": args.proxy_views, "command": shlex.join(words)}
    more |= {"opacity": args.opacity, "hints": args.hints()}
    jobs, left_out = make_jobs(sources, grid, measured, **more)
    return jobs, options, [*notes, *left_out]


def _draw(args: opt.Args, notes: Sequence[str], num_done: int) -> None:
    """Draw charts, page and table of all runs in the folder, and print a summary.

    ``notes`` were printed before.
    """
    from gsmerge.report import document_head
    from gsmerge.research.charts.chart_page import make_page, make_table
    from gsmerge.research.charts.figures import draw_figures, make_figures
    from gsmerge.research.charts.lines import Results
    from gsmerge.research.charts.measure_run import read_runs

    out = args.output
    records, more = read_runs(out)
    if not records:
        raise UsageError(f"{out}: expected finished runs, found none; name scenes to run")
    say_notes(more, quiet=args.silent)
    figures = make_figures(Results(records))
    drawings = draw_figures(figures, out / CHARTS)
    command = shlex.join(["gsmerge", "chart", "--draw-only", "--output", str(out)])
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
