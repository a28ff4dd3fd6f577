"""``gsmerge chart``: a grid of experiments, charts of it and a page."""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from dataclasses import replace
from inspect import Parameter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, duration, print_document, say_notes, total_progress
from gsmerge.cli.held_out import lpips_networks
from gsmerge.cli.paths import write_texts
from gsmerge.errors import BatchError, UsageError

if TYPE_CHECKING:
    from gsmerge.research.charts.record import RunRecord
    from gsmerge.research.charts.run import Plan, RunOptions

GRID = "Grid: comma-separated lists, whose product is run"
LISTS = ("methods", "k", "budgets", "superpixels", "segmentations", "fit", "efforts", "matches", "views")
HINTS = ("opacity", "exporter", "quats", "order", "scene_scale", "max_side")


def _list(name: str, help: str, wording: str) -> Parameter:
    return opt.option(name, str, help, wording=wording, metavar="LIST")


@opt.command(
    opt.argument("scenes", list[Path] | None, "SCENES", ".ply files, or the folders that they are in.", default=None),
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
    opt.HINTS,
    *opt.panel(
        opt.INPUT,
        opt.option("targets", str, "Cameras of held-out photos: one file, or with {scene}, {parent} and {stem} of each "
                   "scene in it."),
        opt.option("target_images", str, "Folder of those photos, in the same way."),
    ),
    "lpips",
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
    _check_usage(args, scenes, out)
    if args.draw_only:
        _print_drawn(args, _draw(out, [], 0), 0)
        return
    from gsmerge.research.charts.run import RunOptions, run_plan

    nets, missing = lpips_networks(args.lpips)
    with opt.usage_errors():
        options = RunOptions(
            nets, args.lpips_views, args.seed or 0, args.threads, args.proxy_views, args.rerun,
            _command(args, scenes, out), hints=args.hints(), opacity=args.opacity,
        )  # fmt: skip
    plan, stored, notes = _make_plan(args, scenes, options)
    notes = [*missing, *notes]
    if args.dry_run:
        _print_plan(args, plan, stored, options, notes)
        return
    say_notes(notes, quiet=args.silent)
    done: list[RunRecord] = []
    more: list[str] = []
    if plan.total > 0:
        with announce_compilation(quiet=args.silent), total_progress(plan.total, quiet=args.silent) as progress:
            done, more = run_plan(plan, out, options, progress)
    say_notes(more, quiet=args.silent)
    _print_drawn(args, _draw(out, [*notes, *more], len(done)), len(notes) + len(more))
    failed = [record for record in done if record.error is not None]
    if failed:
        raise BatchError(f"{len(failed)} of {len(done)} runs failed; the first: {failed[0].scene}: {failed[0].error}")


def _check_usage(args: opt.Args, scenes: Sequence[Path], out: Path) -> None:
    """Refuse wrong usage before anything heavy is loaded."""
    if args.draw_only == bool(scenes):
        raise UsageError("expected scenes to run, or --draw-only without any")
    if args.draw_only and args.dry_run:
        raise UsageError("--dry-run: expected something to run, got --draw-only")
    if os.path.lexists(out) and not out.is_dir():
        raise UsageError(f"--output: expected a folder, found the file {out}")
    if any(os.path.realpath(out) == os.path.realpath(scene) for scene in scenes):
        raise UsageError(f"--output: expected a folder of its own, got the scene {out}")
    if not args.dry_run:
        from gsmerge.research.charts.draw import require_matplotlib

        require_matplotlib()


def _command(args: opt.Args, scenes: Sequence[Path], out: Path) -> str:
    """The command line that does the same, without options left at their default."""
    words = ["gsmerge", "chart", *map(str, scenes), "--output", str(out)]
    names = [*LISTS, "fixed", "grid", "targets", "target_images", *HINTS, "lpips", "lpips_views", "proxy_views"]
    for name, value in args.given([*names, "seed", "threads"]).items():
        if value != "auto" or name not in HINTS:
            for one in value if isinstance(value, list) else [value]:
                words += [f"--{name.replace('_', '-')}", str(one)]
    return shlex.join(words)


def _make_plan(
    args: opt.Args, scenes: Sequence[Path], options: RunOptions
) -> tuple[Plan, dict[str, RunRecord], list[str]]:
    """The runs of the grid, records of earlier runs, and notes."""
    from gsmerge.research.charts.experiment import Grid, make_experiments, parse_grid, read_grid
    from gsmerge.research.charts.run import make_plan
    from gsmerge.research.charts.scenes import find_scenes

    base = Grid() if args.grid is None else read_grid(args.grid)
    base = replace(base, fixed=tuple(args.fixed)) if args.fixed else base
    experiments, notes = make_experiments(scenes, parse_grid({name: getattr(args, name) for name in LISTS}, base))
    places = find_scenes(scenes, args.targets, args.target_images)
    plan, stored = make_plan(experiments, places, args.output, options)
    return plan, stored, [*notes, *plan.notes]


def _print_plan(
    args: opt.Args, plan: Plan, stored: dict[str, RunRecord], options: RunOptions, notes: Sequence[str]
) -> None:
    from gsmerge.report import document_head
    from gsmerge.research.charts.run import describe, estimate_seconds

    out, runs = args.output, [run for run in plan.runs if run[0] in plan.pending]
    seconds = estimate_seconds(runs, stored, options)
    proxies = sum(map(len, plan.proxies.values()))
    document = {
        **document_head(),
        "dry_run": True,
        "output": str(out),
        "num_runs": len(plan.runs),
        "num_pending": len(runs),
        "num_proxies": proxies,
        "estimate": {"seconds": round(seconds, 1)},
        "runs": [
            {"scene": place.name, "run": describe(e), "pending": key in plan.pending} for key, e, place in plan.runs
        ],
        "notes": list(notes),
    }
    lines = [f"{place.name}: {describe(experiment)}" for _, experiment, place in runs]
    lines += [f"note: {note}" for note in notes]
    lines.append(f"would write {out}: {len(runs)} of {len(plan.runs)} runs to do, {proxies} points of superpixels")
    lines.append(f"estimate    about {duration(seconds)}")
    print_document(document, lines, as_json=args.json)


def _draw(out: Path, notes: Sequence[str], num_done: int) -> dict[str, Any]:
    """Draw charts and page of everything in the folder; returns the document about them."""
    from gsmerge.report import document_head
    from gsmerge.research.charts.draw import draw_figures
    from gsmerge.research.charts.figures import make_figures, make_verdict_tables
    from gsmerge.research.charts.page import make_page
    from gsmerge.research.charts.proxies import read_proxies
    from gsmerge.research.charts.record import CHARTS, PAGE, read_runs
    from gsmerge.research.charts.series import newest

    stored, unread = read_runs(out)
    proxies, more = read_proxies(out)
    if not stored:
        raise UsageError(f"{out}: expected finished runs, found none; name scenes to run")
    records, passed = newest(list(stored.values()))
    figures, verdicts = make_figures(records, list(proxies.values())), make_verdict_tables(records)
    drawings = draw_figures(figures, out / CHARTS)
    command = shlex.join(["gsmerge", "chart", "--draw-only", "--output", str(out)])
    page = make_page(records, figures, drawings, verdicts, out, command=command)
    write_texts({out / PAGE: page}, overwrite=True)
    return {
        **document_head(),
        "output": str(out),
        "page": str(out / PAGE),
        "charts": [str(out / CHARTS / f"{figure.name}.{suffix}") for figure in figures for suffix in ("png", "svg")],
        "num_runs": len(records),
        "num_done": num_done,
        "num_failed": sum(record.error is not None for record in records),
        "runs": [record.to_dict() for record in records],
        "notes": [*notes, *(note for note in (*unread, *more, *passed) if note not in notes)],
    }


def _print_drawn(args: opt.Args, document: dict[str, Any], num_said: int) -> None:
    """Print what was drawn, and the notes except for the first ones, which were printed before."""
    say_notes(document["notes"][num_said:], quiet=args.silent)
    failed = f", {document['num_failed']} failed" if document["num_failed"] else ""
    line = f"{document['page']}: {document['num_runs']} runs ({document['num_done']} new{failed}),"
    line += f" {len(document['charts']) // 2} charts"
    print_document(document, line, as_json=args.json, quiet=args.quiet)
