"""``gsmerge chart``: a grid of experiments, charts of it and a page."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, duration, one_line, say_notes, total_progress
from gsmerge.cli.held_out import networks
from gsmerge.cli.settings import reading_of, told_as_usage
from gsmerge.errors import BatchError, UsageError

if TYPE_CHECKING:
    from gsmerge.research.charts.experiment import Grid
    from gsmerge.research.charts.record import RunRecord
    from gsmerge.research.charts.run import Plan, RunOptions

GRID, MEASURING = "Grid: comma-separated lists, whose product is run", "Measuring"


def _list(help: str, default: str, name: str | None = None) -> Any:
    names = () if name is None else (name,)
    return typer.Option(*names, metavar="LIST", help=help, show_default=default, rich_help_panel=GRID)


def _told(panel: str, help: str, **settings: Any) -> Any:
    return typer.Option(help=help, rich_help_panel=panel, **settings)


List = str | None
Scenes = Annotated[
    list[Path] | None, typer.Argument(metavar="SCENES", help=".ply files, or the folders that they are in.")
]
Methods = Annotated[List, _list("Methods: gsmerge and others to compare it with.", "gsmerge")]
Ks = Annotated[List, _list("Gaussians per superpixel: 1 to 8, auto.", "1", "--k")]
Budgets = Annotated[List, _list('Gaussians in the result, such as "0.5%,2%,40000".', "as density says")]
Densities = Annotated[List, _list("Superpixels per pixel, beside the budgets.", "0.044")]
Segmentations = Annotated[List, _list("Superpixel methods.", "rdseg")]
Fits = Annotated[List, _list("What is fitted: full, color, none.", "full")]
Efforts = Annotated[List, _list("Work put in: fast, default, best.", "default")]
Matches = Annotated[List, _list("Merging across views: overlap, aabb, none.", "overlap")]
Fixed = Annotated[
    list[str] | None,
    _told(GRID, "Any other setting of compact for all runs of ours; may be repeated.", metavar="NAME=VALUE"),
]
NumViews = Annotated[List, _list("Numbers of input views, evenly spread; all for all.", "all")]
GridFile = Annotated[Path | None, _told(GRID, "TOML or JSON file with these lists; options win.")]
Targets = Annotated[
    str | None,
    _told(opt.INPUT, "Cameras of held-out photos: one file, or with {scene}, {parent} and {stem} of each scene in it."),
]
TargetImages = Annotated[str | None, _told(opt.INPUT, "Folder of those photos, in the same way.")]
LpipsViews = Annotated[int, _told(MEASURING, "Measure it on at most so many views of each split.", min=1)]
ProxyViews = Annotated[int, _told(MEASURING, "Photos per scene to measure superpixels on.", min=0)]
Out = Annotated[Path, _told(opt.OUTPUT, "Results folder; runs that it has already are not repeated.")]
Rerun = Annotated[bool, typer.Option("--rerun", help="Repeat runs that are done.", rich_help_panel=opt.OUTPUT)]
DrawOnly = Annotated[
    bool, typer.Option("--draw-only", help="Draw what the folder has; run nothing.", rich_help_panel=opt.OUTPUT)
]


def chart(
    scenes: Scenes = None,
    methods: Methods = None,
    k: Ks = None,
    budgets: Budgets = None,
    densities: Densities = None,
    segmentations: Segmentations = None,
    fit: Fits = None,
    efforts: Efforts = None,
    matches: Matches = None,
    views: NumViews = None,
    fixed: Fixed = None,
    grid: GridFile = None,
    opacity: opt.OpacityOption = opt.Opacity.auto,
    exporter: opt.DialectOption = "auto",
    quats: opt.QuatsOption = opt.Quats.auto,
    order: opt.OrderOption = opt.Order.auto,
    scene_scale: opt.SceneScaleOption = None,
    max_side: opt.MaxSideOption = None,
    targets: Targets = None,
    target_images: TargetImages = None,
    lpips: opt.LpipsOption = None,
    lpips_views: LpipsViews = 2,
    proxy_views: ProxyViews = 2,
    out: Out = Path("charts"),
    rerun: Rerun = False,
    draw_only: DrawOnly = False,
    seed: opt.SeedOption = None,
    threads: opt.ThreadsOption = None,
    json: opt.JsonOption = False,
    dry_run: opt.DryRunOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Run a grid of settings over scenes, resumable, and draw charts and a page of all results in the folder."""
    given = scenes or []
    _check_usage(given, out, draw_only=draw_only, dry_run=dry_run)
    if draw_only:
        _tell(_drawn(out, [], 0), 0, as_json=json, quiet=quiet)
        return
    from gsmerge.research.charts.run import RunOptions

    lists = {"methods": methods, "k": k, "budgets": budgets, "densities": densities, "segmentations": segmentations}
    lists |= {"fit": fit, "efforts": efforts, "matches": matches, "views": views}
    typed: dict[str, Any] = {**lists, "fixed": fixed, "grid": grid, "targets": targets, "target_images": target_images}
    read = {"opacity": opacity.value, "exporter": exporter, "quats": quats.value, "order": order.value}
    typed |= {name: value for name, value in read.items() if value != "auto"}
    typed |= {
        "scene_scale": scene_scale,
        "max_side": max_side,
        "lpips": lpips and lpips.value,
        "lpips_views": lpips_views,
    }
    typed |= {"proxy_views": proxy_views}
    command = _command(given, out, {**typed, "seed": seed, "threads": threads})
    nets, missing = networks(lpips)
    with told_as_usage():
        hints = reading_of(exporter, quats.value, order.value, scene_scale, max_side)
        told = RunOptions(
            nets, lpips_views, seed or 0, threads, proxy_views, rerun, command, hints=hints, opacity=opacity.value
        )
    plan, stored, notes = _planned(given, _grid(grid, lists, fixed), out, targets, target_images, told)
    notes = [*missing, *notes]
    if dry_run:
        _print_plan(plan, stored, told, out, notes, as_json=json)
        return
    say_notes(notes, quiet=quiet or json)
    done, more = _run(plan, out, told, quiet=quiet or json)
    say_notes(more, quiet=quiet or json)
    _tell(_drawn(out, [*notes, *more], len(done)), len(notes) + len(more), as_json=json, quiet=quiet)
    failed = [record for record in done if record.error is not None]
    if failed:
        raise BatchError(f"{len(failed)} of {len(done)} runs failed; the first: {failed[0].scene}: {failed[0].error}")


def _check_usage(scenes: Sequence[Path], out: Path, *, draw_only: bool, dry_run: bool) -> None:
    """What can be refused before anything heavy is loaded."""
    if draw_only == bool(scenes):
        raise UsageError("expected scenes to run, or --draw-only without any")
    if draw_only and dry_run:
        raise UsageError("--dry-run: expected something to run, got --draw-only")
    _check_out(out, scenes)
    if not dry_run:
        from gsmerge.research.charts.draw import require_matplotlib

        require_matplotlib()


def _check_out(out: Path, scenes: Sequence[Path]) -> None:
    """Refuse a results folder that is a file, or one of the scenes."""
    if os.path.lexists(out) and not out.is_dir():
        raise UsageError(f"--out: expected a folder, found the file {out}")
    if any(os.path.realpath(out) == os.path.realpath(scene) for scene in scenes):
        raise UsageError(f"--out: expected a folder of its own, got the scene {out}")


def _grid(file: Path | None, lists: dict[str, str | None], fixed: Sequence[str] | None) -> Grid:
    from gsmerge.research.charts.experiment import Grid, parse_grid, read_grid

    base = Grid() if file is None else read_grid(file)
    return parse_grid(lists, replace(base, fixed=tuple(fixed)) if fixed else base)


def _command(scenes: Sequence[Path], out: Path, told: dict[str, Any]) -> str:
    """The command line that does the same, without what was left at its default."""
    words = ["gsmerge", "chart", *map(str, scenes), "--out", str(out)]
    for name, value in told.items():
        for one in value if isinstance(value, list) else [] if value is None else [value]:
            words += [f"--{name.replace('_', '-')}", str(one)]
    return shlex.join(words)


def _planned(
    scenes: Sequence[Path], grid: Grid, out: Path, targets: str | None, target_images: str | None, options: RunOptions
) -> tuple[Plan, dict[str, RunRecord], list[str]]:
    from gsmerge.research.charts.experiment import make_experiments
    from gsmerge.research.charts.run import make_plan
    from gsmerge.research.charts.scenes import find_scenes

    experiments, notes = make_experiments(scenes, grid)
    plan, stored = make_plan(experiments, find_scenes(scenes, targets, target_images), out, options)
    return plan, stored, [*notes, *plan.notes]


def _run(plan: Plan, out: Path, options: RunOptions, *, quiet: bool) -> tuple[list[RunRecord], list[str]]:
    from gsmerge.research.charts.run import run_plan

    if plan.total == 0:
        return [], []
    with announce_compilation(quiet=quiet), total_progress(plan.total, quiet=quiet) as progress:
        return run_plan(plan, out, options, progress)


def _print_plan(
    plan: Plan, stored: dict[str, RunRecord], options: RunOptions, out: Path, notes: Sequence[str], *, as_json: bool
) -> None:
    from gsmerge.report import document_head, to_json
    from gsmerge.research.charts.run import describe, estimate_seconds
    from gsmerge.runtime.threads import available_threads

    runs = [run for run in plan.runs if run[0] in plan.pending]
    threads = options.threads or available_threads()
    nets, most = options.lpips, options.lpips_views
    seconds = estimate_seconds(runs, stored, threads=threads, lpips=nets, lpips_views=most)
    proxies = sum(map(len, plan.proxies.values()))
    if as_json:
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
        sys.stdout.write(to_json(document))
        return
    lines = [f"{place.name}: {describe(experiment)}" for _, experiment, place in runs]
    lines += [f"note: {note}" for note in notes]
    lines.append(f"would write {out}: {len(runs)} of {len(plan.runs)} runs to do, {proxies} points of superpixels")
    lines.append(f"estimate    about {duration(seconds)}")
    print("\n".join(map(one_line, lines)))


def _drawn(out: Path, notes: Sequence[str], num_done: int) -> dict[str, Any]:
    """Charts and page of everything in the folder; what was made, as a document."""
    from gsmerge.io import atomic_output
    from gsmerge.report import document_head
    from gsmerge.research.charts.draw import draw_figures
    from gsmerge.research.charts.figures import make_figures, make_verdict_tables
    from gsmerge.research.charts.page import make_page
    from gsmerge.research.charts.proxies import read_proxies
    from gsmerge.research.charts.record import CHARTS, PAGE, read_runs
    from gsmerge.research.charts.series import newest

    stored, told = read_runs(out)
    proxies, more = read_proxies(out)
    if not stored:
        raise UsageError(f"{out}: expected finished runs, found none; name scenes to run")
    records, passed = newest(list(stored.values()))
    figures, verdicts = make_figures(records, list(proxies.values())), make_verdict_tables(records)
    drawings = draw_figures(figures, out / CHARTS)
    command = shlex.join(["gsmerge", "chart", "--draw-only", "--out", str(out)])
    page = make_page(records, figures, drawings, verdicts, out, command=command)
    with atomic_output(out / PAGE, overwrite=True) as temporary:
        temporary.write_text(page, encoding="utf-8", errors="replace")
    return {
        **document_head(),
        "output": str(out),
        "page": str(out / PAGE),
        "charts": [str(out / CHARTS / f"{figure.name}.{suffix}") for figure in figures for suffix in ("png", "svg")],
        "num_runs": len(records),
        "num_done": num_done,
        "num_failed": sum(record.error is not None for record in records),
        "runs": [record.to_dict() for record in records],
        "notes": [*notes, *(note for note in (*told, *more, *passed) if note not in notes)],
    }


def _tell(document: dict[str, Any], num_said: int, *, as_json: bool, quiet: bool) -> None:
    """What was drawn, and the notes but for the first ones, which were said before."""
    from gsmerge.report import to_json

    say_notes(document["notes"][num_said:], quiet=quiet or as_json)

    if as_json:
        sys.stdout.write(to_json(document))
    elif not quiet:
        failed = f", {document['num_failed']} failed" if document["num_failed"] else ""
        print(
            one_line(
                f"{document['page']}: {document['num_runs']} runs ({document['num_done']} new{failed}),"
                f" {len(document['charts']) // 2} charts"
            )
        )
