"""Make a self-contained HTML file with tables, figures, pictures to compare, commands and environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from gsmerge.pages.page import PICTURES, data_uri, render_template
from gsmerge.report import csv_text
from gsmerge.research.charts.figures import Figure
from gsmerge.research.charts.lines import METRICS, MIN_SCENES, PARTS, Interval, Results, line_key, own_first, size_label
from gsmerge.research.charts.measure_run import INPUT, MAX_ERROR, SCORES, RunRecord, list_held_out_notes, picture_path
from gsmerge.runtime.memory import human_bytes, human_share
from gsmerge.settings.compact import OURS

MAX_SCENES = 6  # most scenes with pictures on the page
MAX_RESULTS = 5  # most pictures of a view in addition to the photo and the input
COSTS = ("Gaussians", "Kept", "File", "Seconds", "ms/view")
MEDIA = {".jpg": "image/jpeg", ".png": "image/png"}  # media types of pictures
Table = tuple[Sequence[str], Sequence[Sequence[str]]]  # head and rows


def make_page(
    records: Sequence[RunRecord], figures: Sequence[Figure], drawings: Mapping[str, bytes], folder: Path, command: str
) -> str:
    """Make the HTML page of charts, which loads nothing from the network.

    ``drawings`` are the SVG of each figure by name. ``command`` is the command line that draws the page again.
    """
    results = Results(records)
    failed = [record for record in records if record.error is not None]
    scenes = list(dict.fromkeys(record.scene for record in records))
    names = ", ".join(scenes[:12]) + (", ..." if len(scenes) > 12 else "")
    words = f"{len(records)} runs on {len(scenes)} scene{'' if len(scenes) == 1 else 's'}: {names}"
    words = "; ".join([words, *list_held_out_notes(records)])
    return render_template(
        "charts.html",
        policy=PICTURES,
        names=names,
        words=words + (f"; {len(failed)} failed" if failed else ""),
        part=PARTS[results.part],
        doubt=results.caveat,
        results=_mean_table(results),
        figures=[(figure, data_uri(drawings[figure.name], "image/svg+xml")) for figure in figures],
        views=_views(results, folder),
        max_error=MAX_ERROR,
        failures=[(record.scene, record.label, record.error) for record in failed],
        machines=list(dict.fromkeys(tuple(record.environment.items()) for record in results.runs)),
        commands=[*dict.fromkeys(record.command for record in results.runs if record.command), command],
    )


def _interval(value: Interval, digits: int) -> str:
    """Write a mean, with the half width of its interval if there are enough scenes."""
    half = value.high - value.mean
    return f"{value.mean:.{digits}f}" + (f" ± {half:.{digits}f}" if value.count >= MIN_SCENES else "")


def _mean(group: Sequence[RunRecord], name: str) -> float | None:
    """Average a value over the records that have it; None if none has it."""
    values = [value for record in group if (value := record.value(name)) is not None]
    return sum(values) / len(values) if values else None


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:,.{digits}f}"


def _mean_table(results: Results) -> Table:
    """Make the table of means over the scenes, with a row for each method, settings and size."""
    intervals = {
        (metric, line.name, point.label): point.y
        for metric in results.metrics
        for line in results.by_size("ratio", f"{metric}_{results.part}")
        for point in line.points
    }
    groups: dict[tuple[str, str], list[RunRecord]] = {}
    lines = list(results.names)
    for record in sorted(results.runs, key=lambda r: (lines.index(line_key(r)), r.ratio or 0.0)):
        if record.views_asked == results.views:
            groups.setdefault((results.name(record), size_label(record)), []).append(record)
    rows = []
    for (name, size), group in groups.items():
        values = ("count", "percent", "bytes", "seconds", "render_ms")
        count, kept, num_bytes, seconds, ms = (_mean(group, value) for value in values)
        row = [name, size, str(len(group)), _number(count, 0), "" if kept is None else human_share(kept / 100)]
        row += ["" if num_bytes is None else human_bytes(num_bytes), _number(seconds or None, 2), _number(ms, 1)]
        for metric in results.metrics:
            interval, digits = intervals.get((metric, name, size)), METRICS[metric].digits
            mean = _number(_mean(group, f"{metric}_{results.part}"), digits)
            row.append(mean if interval is None else _interval(interval, digits))
        rows.append(row)
    return ("Method", "Size", "Scenes", *COSTS, *(METRICS[metric].label for metric in results.metrics)), rows


def _views(results: Results, folder: Path) -> list[tuple[str, list[tuple[str, str]], int]]:
    """List views with their title, their named pictures, and the index of the picture of gsmerge's own result."""
    views = []
    for scene in list(dict.fromkeys(record.scene for record in results.runs))[:MAX_SCENES]:
        records = [r for r in results.runs if r.scene == scene and r.views_asked == results.views and r.pictures]
        typical = own_first(r for r in records if results.is_typical(r))[:MAX_RESULTS]
        compared = [*(r for r in records if r.method == INPUT), *typical]
        for i, view in enumerate(compared[0].pictures if compared else ()):
            files = [("photo", picture_path(folder, f"{scene}/photo", i, "photo"))]
            files += [(results.name(r), picture_path(folder, r.output, i, "render")) for r in compared]
            files += [(f"error of {results.name(r)}", picture_path(folder, r.output, i, "error")) for r in compared]
            layers = [(name, data_uri(path.read_bytes(), MEDIA[path.suffix])) for name, path in files if path.is_file()]
            own = next((i for i, (name, _) in enumerate(layers) if name.startswith(OURS)), len(layers) - 1)
            views += [(f"{scene}, {view}", layers, own)] if len(layers) > 1 else []
    return views


def make_table(records: Sequence[RunRecord]) -> str:
    """Write all runs and scores as comma-separated values."""
    names = ("scene", "label", "method", "views", "num_input", "count", "ratio", "bytes", "seconds", "render_ms")
    return csv_text((*names, *SCORES, "error"), (record.to_dict() for record in records))
