"""Make the two summaries of a folder of runs: an HTML page with tables and figures, and a CSV table of all runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict

from gsmerge.drawing.pages.page import PICTURES_POLICY, data_uri, render_template
from gsmerge.research.charts.figures import Chart
from gsmerge.research.charts.lines import CHART_METRICS, MIN_SCENES, PARTS, Results, size_label
from gsmerge.research.charts.measure_run import RunRecord
from gsmerge.runtime.documents import csv_text

COSTS = ("Gaussians", "Kept", "Bytes", "Seconds")
ChartTable = tuple[Sequence[str], Sequence[Sequence[str]]]  # head and rows


def make_chart_page(
    records: Sequence[RunRecord], figures: Sequence[Chart], drawings: Mapping[str, bytes], command: str
) -> str:
    """Make the HTML page of charts, which loads nothing from the network.

    ``drawings`` are the SVG of each figure by name. ``command`` is the command line that makes the page again.
    """
    results = Results(records)
    failed = [record for record in records if record.error is not None]
    scenes = list(dict.fromkeys(record.scene for record in records))
    names = ", ".join(scenes[:12]) + (", ..." if len(scenes) > 12 else "")
    words = f"{len(records)} runs on {len(scenes)} scene{'' if len(scenes) == 1 else 's'}: {names}"
    words = "; ".join([words, *list_held_out_notes(records)])
    return render_template(
        "charts.html",
        policy=PICTURES_POLICY,
        names=names,
        words=words + (f"; {len(failed)} failed" if failed else ""),
        part=PARTS[results.part],
        doubt=results.caveat,
        results=_mean_table(results),
        figures=[(figure, data_uri(drawings[figure.name], "image/svg+xml")) for figure in figures],
        failures=[(record.scene, record.label, record.error) for record in failed],
        command=command,
    )


def list_held_out_notes(records: Sequence[RunRecord]) -> list[str]:
    """For each scene without targets, list the photos that were held out of its runs."""
    why = "without --targets, these photos are hidden from all runs, which are scored on them"
    names = {record.scene: record.held_out for record in records if record.held_out}
    return [f"{scene}: {why}: {', '.join(photos)}" for scene, photos in names.items()]


def _mean_table(results: Results) -> ChartTable:
    """Make the table of means over the scenes, with a row for each method, settings and size."""
    intervals = {
        (metric, line.name, point.label): point.y
        for metric in results.metrics
        for line in results.by_size("percent", f"{metric}_{results.part}")
        for point in line.points
    }
    groups: dict[tuple[str, str], list[RunRecord]] = {}
    for record in results.runs:
        groups.setdefault((results.name(record), size_label(record)), []).append(record)
    rows = []
    for (name, size), group in groups.items():
        count, kept, num_bytes, seconds = (
            sum(record.value(cost) or 0 for record in group) / len(group)
            for cost in ("count", "percent", "bytes", "seconds")
        )
        row = [name, size, str(len(group)), f"{count:,.0f}", f"{kept:.3g} %", f"{num_bytes:,.0f}", f"{seconds:.2f}"]
        for metric in results.metrics:
            digits = CHART_METRICS[metric].digits
            values = [r.value(f"{metric}_{results.part}") for r in group]
            known = [value for value in values if value is not None]
            score_text = f"{sum(known) / len(known):.{digits}f}" if known else ""
            if (interval := intervals.get((metric, name, size))) and interval.count >= MIN_SCENES:
                score_text = (
                    f"{interval.mean:.{digits}f} \N{PLUS-MINUS SIGN} {interval.high - interval.mean:.{digits}f}"
                )
            row.append(score_text)
        rows.append(row)
    return ("Method", "Size", "Scenes", *COSTS, *(CHART_METRICS[metric].label for metric in results.metrics)), rows


def make_table(records: Sequence[RunRecord]) -> str:
    """Write all runs and scores as comma-separated values."""
    names = ("scene", "label", "method", "num_input", "count", "bytes", "seconds")
    scores = list(dict.fromkeys(name for record in records for name in record.scores))
    return csv_text((*names, *scores, "error"), ({**asdict(record), **record.scores} for record in records))
