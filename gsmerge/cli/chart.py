"""``gsmerge chart``: a grid of experiments, charts of it and a page."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, one_line, say, say_notes
from gsmerge.cli.held_out import networks
from gsmerge.cli.options import Lpips
from gsmerge.cli.settings import told_as_usage
from gsmerge.errors import BatchError, UsageError

if TYPE_CHECKING:
    from gsmerge.charts.experiment import Grid
    from gsmerge.charts.record import RunRecord
    from gsmerge.charts.run import Plan, RunOptions

GRID, MEASURING = "Grid: comma-separated lists, whose product is run", "Measuring"


def _list(help: str, default: str, name: str | None = None) -> Any:
    names = () if name is None else (name,)
    return typer.Option(*names, metavar="LIST", help=help, show_default=default, rich_help_panel=GRID)


def chart(
    scenes: Annotated[
        list[Path] | None, typer.Argument(metavar="SCENES", help=".ply files, or the folders that they are in.")
    ] = None,
    methods: Annotated[str | None, _list("Methods: gsmerge and others to compare it with.", "gsmerge")] = None,
    k: Annotated[str | None, _list("Gaussians per superpixel: 1 to 8, auto.", "1", "--k")] = None,
    budgets: Annotated[
        str | None, _list('Gaussians in the result, such as "0.5%,2%,40000".', "as density says")
    ] = None,
    densities: Annotated[str | None, _list("Superpixels per pixel, beside the budgets.", "0.044")] = None,
    segmentations: Annotated[str | None, _list("Superpixel methods.", "rdseg")] = None,
    fit: Annotated[str | None, _list("What is fitted: full, color, none.", "full")] = None,
    efforts: Annotated[str | None, _list("Work put in: fast, default, best.", "default")] = None,
    matches: Annotated[str | None, _list("Merging across views: overlap, aabb, none.", "overlap")] = None,
    views: Annotated[str | None, _list("Numbers of input views, evenly spread; all for all.", "all")] = None,
    grid: Annotated[
        Path | None, typer.Option(help="TOML or JSON file with these lists; options win.", rich_help_panel=GRID)
    ] = None,
    targets: Annotated[
        str | None,
        typer.Option(
            help="Cameras of held-out photos: one file, or with {scene}, {parent} and {stem} of each scene in it.",
            rich_help_panel=opt.INPUT,
        ),
    ] = None,
    target_images: Annotated[
        str | None, typer.Option(help="Folder of those photos, in the same way.", rich_help_panel=opt.INPUT)
    ] = None,
    lpips: opt.LpipsOption = None,
    lpips_views: Annotated[
        int, typer.Option(min=1, help="Measure it on at most so many views of each split.", rich_help_panel=MEASURING)
    ] = 2,
    proxy_views: Annotated[
        int, typer.Option(min=0, help="Photos per scene to measure superpixels on.", rich_help_panel=MEASURING)
    ] = 2,
    out: Annotated[
        Path,
        typer.Option(help="Results folder; runs that it has already are not repeated.", rich_help_panel=opt.OUTPUT),
    ] = Path("charts"),
    rerun: Annotated[
        bool, typer.Option("--rerun", help="Repeat runs that are done.", rich_help_panel=opt.OUTPUT)
    ] = False,
    draw_only: Annotated[
        bool, typer.Option("--draw-only", help="Draw what the folder has; run nothing.", rich_help_panel=opt.OUTPUT)
    ] = False,
    seed: opt.SeedOption = None,
    threads: opt.ThreadsOption = None,
    json: opt.JsonOption = False,
    dry_run: opt.DryRunOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Run a grid of settings over scenes, resumable, and draw charts and a page of all results in the folder."""
    if draw_only == bool(scenes):
        raise UsageError("expected scenes to run, or --draw-only without any")
    _check_out(out, scenes or [])
    lists = {"methods": methods, "k": k, "budgets": budgets, "densities": densities, "segmentations": segmentations}
    lists |= {"fit": fit, "efforts": efforts, "matches": matches, "views": views}
    from gsmerge.charts.draw import require_matplotlib

    if not dry_run:
        require_matplotlib()
    done: list[RunRecord] = []
    notes: list[str] = []
    if not draw_only:
        from gsmerge.charts.run import RunOptions

        nets, missing = _networks(lpips)
        typed: dict[str, Any] = {**lists, "grid": grid, "targets": targets, "target_images": target_images}
        typed |= {"lpips": lpips and lpips.value, "lpips_views": lpips_views, "seed": seed, "threads": threads}
        command = _command(scenes or [], out, typed)
        with told_as_usage():
            told = RunOptions(nets, lpips_views, seed or 0, threads, proxy_views, rerun, command)
        plan, stored, notes = _planned(scenes or [], _grid(grid, lists), out, targets, target_images, told)
        if dry_run:
            _print_plan(plan, stored, told, out, notes, as_json=json)
            return
        notes = [*missing, *notes]
        say_notes(notes, quiet=quiet or json)
        done, more = _run(plan, out, told, quiet=quiet or json)
        say_notes(more, quiet=quiet or json)
        notes += more
    elif dry_run:
        raise UsageError("--dry-run: expected something to run, got --draw-only")
    document = _drawn(out, notes, len(done))
    _tell(document, as_json=json, quiet=quiet)
    failed = [record for record in done if record.error is not None]
    if failed:
        raise BatchError(f"{len(failed)} of {len(done)} runs failed; the first: {failed[0].scene}: {failed[0].error}")


def _check_out(out: Path, scenes: Sequence[Path]) -> None:
    """Refuse a results folder that is a file, or one of the scenes."""
    if os.path.lexists(out) and not out.is_dir():
        raise UsageError(f"--out: expected a folder, found the file {out}")
    if any(os.path.realpath(out) == os.path.realpath(scene) for scene in scenes):
        raise UsageError(f"--out: expected a folder of its own, got the scene {out}")


def _grid(file: Path | None, lists: dict[str, str | None]) -> Grid:
    from gsmerge.charts.experiment import Grid, parse_grid, read_grid

    return parse_grid(lists, Grid() if file is None else read_grid(file))


def _networks(asked: Lpips | None) -> tuple[tuple[str, ...], list[str]]:
    """The networks of LPIPS; those that were asked for must be there before the first run."""
    from gsmerge.perceptual import INSTALL, lpips_available

    nets, missing = networks(asked)
    if not all(map(lpips_available, nets)):
        raise UsageError(f"--lpips: its weights are not installed: {INSTALL}; or pass --lpips none")
    return nets, missing


def _command(scenes: Sequence[Path], out: Path, told: dict[str, Any]) -> str:
    """The command line that does the same, without what was left at its default."""
    words = ["gsmerge", "chart", *map(str, scenes), "--out", str(out)]
    for name, value in told.items():
        if value is not None:
            words += [f"--{name.replace('_', '-')}", str(value)]
    return shlex.join(words)


def _planned(
    scenes: Sequence[Path], grid: Grid, out: Path, targets: str | None, target_images: str | None, options: RunOptions
) -> tuple[Plan, dict[str, RunRecord], list[str]]:
    from gsmerge.charts.experiment import make_experiments
    from gsmerge.charts.places import find_places
    from gsmerge.charts.run import make_plan

    experiments, notes = make_experiments(scenes, grid)
    plan, stored = make_plan(experiments, find_places(scenes, targets, target_images), out, options)
    return plan, stored, [*notes, *plan.notes]


def _run(plan: Plan, out: Path, options: RunOptions, *, quiet: bool) -> tuple[list[RunRecord], list[str]]:
    from gsmerge.charts.run import run_plan

    if plan.total == 0:
        return [], []
    with announce_compilation(quiet=quiet), grid_progress(plan.total, quiet=quiet) as progress:
        return run_plan(plan, out, options, progress)


@contextmanager
def grid_progress(total: int, *, quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """One bar for the whole grid on stderr: done of total, time left; a line per run where there is no terminal."""
    if quiet:
        yield lambda what, done, total: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda what, done, total: say(f"{done}/{total} {what}")
        return
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
    with Progress(*columns, TextColumn("{task.description}"), console=console, transient=True) as bars:
        task = bars.add_task("", total=total)
        yield lambda what, done, total: bars.update(task, completed=done, total=total, description=one_line(what))


def _print_plan(
    plan: Plan, stored: dict[str, RunRecord], options: RunOptions, out: Path, notes: Sequence[str], *, as_json: bool
) -> None:
    from gsmerge.charts.estimate import estimate_seconds
    from gsmerge.charts.run import describe
    from gsmerge.report import document_head, to_json
    from gsmerge.threads import available_threads

    runs = [run for run in plan.runs if run[0] in plan.pending]
    threads = options.threads or available_threads()
    seconds = estimate_seconds(runs, stored, threads=threads, lpips=options.lpips)
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
    lines.append(f"estimate    about {_duration(seconds)}")
    print("\n".join(map(one_line, lines)))


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _drawn(out: Path, notes: Sequence[str], num_done: int) -> dict[str, Any]:
    """Charts and page of everything in the folder; what was made, as a document."""
    from gsmerge.charts.draw import draw_figures
    from gsmerge.charts.figures import make_figures, make_verdicts
    from gsmerge.charts.page import make_page
    from gsmerge.charts.proxies import read_proxies
    from gsmerge.charts.store import CHARTS, PAGE, read_runs
    from gsmerge.io import atomic_output
    from gsmerge.report import document_head

    stored, told = read_runs(out)
    proxies, more = read_proxies(out)
    if not stored:
        raise UsageError(f"{out}: expected finished runs, found none; name scenes to run")
    records = list(stored.values())
    figures, verdicts = make_figures(records, list(proxies.values())), make_verdicts(records)
    drawings = draw_figures(figures, out / CHARTS)
    command = shlex.join(["gsmerge", "chart", "--draw-only", "--out", str(out)])
    page = make_page(records, figures, drawings, verdicts, out, command=command)
    with atomic_output(out / PAGE, overwrite=True) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return {
        **document_head(),
        "output": str(out),
        "page": str(out / PAGE),
        "charts": [str(out / CHARTS / f"{figure.name}.{suffix}") for figure in figures for suffix in ("png", "svg")],
        "num_runs": len(records),
        "num_done": num_done,
        "num_failed": sum(record.error is not None for record in records),
        "runs": [record.to_dict() for record in records],
        "notes": [*notes, *(note for note in (*told, *more) if note not in notes)],
    }


def _tell(document: dict[str, Any], *, as_json: bool, quiet: bool) -> None:
    from gsmerge.report import to_json

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
