"""``gsmerge lab chart``: run a grid of settings, and make charts and a page of the results."""

import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from gsmerge.cli import parameters as opt
from gsmerge.cli.batch_command import check_failures
from gsmerge.cli.before_after import lpips_networks
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.cli.paths import write_texts
from gsmerge.errors import UsageError
from gsmerge.frozen import asdict, dataclass, replace
from gsmerge.runtime.documents import document_head, note_entries
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.evaluate import NETS
from gsmerge.settings.setting import Settings, flat_settings, setting

if TYPE_CHECKING:
    from gsmerge.research.charts.grid import GridRun
    from gsmerge.scoring.evaluate import EvaluateOptions

# a folder and two files in the output folder
CHARTS = "charts"
PAGE = "index.html"
TABLE = "runs.csv"


@dataclass(frozen=True)
class ChartOptions(Settings):
    """Settings of a grid's measurements."""

    lpips: str | None = setting(None, "Networks of LPIPS; by default those installed.", choices=("both", *NETS, "none"))
    lpips_views: int = setting(2, "Measure LPIPS on at most so many views of each split.", least=1)
    rerun: bool = setting(False, "Repeat runs that are done.")


SETTINGS = (CompactOptions, ChartOptions)


def chart(
    scenes: Annotated[list[str] | None, opt.argument("[SCENE]...", "Folders to search for scenes, patterns, .ply "
        "files, or text files with one of these per line. None: draw the results in the folder.", read=None)] = None,
    grid: Annotated[list[str] | None, opt.option("Runs", "NAME=A,B", "Values of a setting to run, in every combination "
        "with those of others, such as budget=1%,4% or method=gsmerge,random; may be repeated.")] = None,
    set: Annotated[list[str] | None, opt.settings_option(SETTINGS, example="lpips=none")] = None,
    targets: Annotated[str | None, opt.option(opt.INPUT, "TEXT", "Cameras of held-out photos: one file, or with "
        "{scene}, {parent} and {stem} of each scene in it.")] = None,
    output: Annotated[Path, opt.output("Folder for the results; runs that it holds are not repeated.",
        default="charts")] = Path("charts"),
    dry_run: opt.DryRun = False,
    json: opt.Json = False, progress: opt.Progress = None, quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Run settings over scenes, and draw charts and a page of all results; a repeated call resumes the runs."""
    from gsmerge.research.charts.grid import find_sources, make_runs, parse_grid
    from gsmerge.research.charts.measure_run import read_runs
    from gsmerge.scoring.evaluate import EvaluateOptions

    scenes = scenes or []
    if os.path.lexists(output) and not output.is_dir():
        raise UsageError(f"--output: expected a folder, found the file {output}")
    if not scenes and dry_run:
        raise UsageError("--dry-run: expected scenes to run, got none")
    given = opt.read_settings(SETTINGS, set)
    (chart_options,) = given.make(ChartOptions)
    fixed = {name: value for name, value in given.values.items() if name not in flat_settings(ChartOptions)}
    with given.usage_errors():
        nets, notes = lpips_networks(chart_options.lpips, NETS) if scenes else ((), [])
        measured = EvaluateOptions(nets, chart_options.lpips_views)
        sources = find_sources(scenes, output, targets) if scenes else []
        runs = make_runs(sources, parse_grid(grid or ()), fixed, measured)
    done = {record.key for record in read_runs(output) if record.error is None and not chart_options.rerun}
    pending = [run for run in runs if run[1].key not in done]
    if dry_run:
        labels = [f"{source.path} -> {output}: {record.label}" for source, record, _ in pending]
        line = f"{output}: {len(pending)} of {len(runs)} runs"
        document = {"runs": labels, "num_runs": len(runs), **note_entries(notes)}
        print_document(document, [*labels, line], as_json=json, quiet=quiet)
        return
    say_notes(notes, quiet=quiet or json)
    failed = _run_all(output, pending, measured, quiet=quiet or json)
    call = ["gsmerge", "lab", "chart", *scenes, "--output", str(output)]  # the equivalent command line
    for name, values in (("grid", grid), ("set", set), ("targets", targets and [targets])):
        call += [word for value in values or () for word in (f"--{name}", value)]
    _draw_results(output, shlex.join(call), notes, len(pending), json=json, quiet=quiet)
    check_failures(failed, len(pending), "run")


def _run_all(
    out: Path, runs: "Sequence[GridRun]", measured: "EvaluateOptions", *, quiet: bool
) -> list[tuple[str, str]]:
    """Do all runs, and append a record of each to the folder. Returns the name and the error of each failed run."""
    from gsmerge.io.jsonl import append_line
    from gsmerge.research.charts.measure_run import RUNS, run_setting

    failed = []
    with stage_progress(quiet=quiet) as progress:
        for i, (source, record, options) in enumerate(runs):
            name = f"{source.name}/{record.label}"
            progress(name, i, len(runs))
            try:
                finished = run_setting(source, record, options, measured)
            except Exception as error:  # a run that fails does not end the others
                finished = replace(record, error=" ".join(f"{type(error).__name__}: {error}".split()))
                failed.append((name, str(finished.error)))
            append_line(out / RUNS, asdict(finished))
    return failed


def _draw_results(out: Path, call: str, notes: Sequence[str], num_done: int, *, json: bool, quiet: bool) -> None:
    """Draw the charts, page and table of all runs in the folder, and print a summary.

    ``notes`` go into the report; these notes are already printed. ``num_done`` is the number of runs of this call.
    """
    from gsmerge.research.charts.chart_page import list_held_out_notes, make_chart_page, make_table
    from gsmerge.research.charts.figures import draw_figures, make_figures
    from gsmerge.research.charts.lines import Results
    from gsmerge.research.charts.measure_run import read_runs

    records = read_runs(out)
    if not records:
        raise UsageError(f"{out}: expected finished runs, found none; name scenes to run")
    say_notes(list_held_out_notes(records), quiet=quiet or json)
    figures = make_figures(Results(records))
    drawings = draw_figures(figures, out / CHARTS)
    page = make_chart_page(records, figures, drawings, call)
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
    print_document(document, f"{line} {len(figures)} charts", as_json=json, quiet=quiet)
