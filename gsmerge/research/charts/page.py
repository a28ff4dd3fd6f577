"""One self-contained HTML file: tables, figures, pictures to compare, commands, environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple
from importlib.resources import files
from pathlib import Path

from gsmerge.report import human_bytes
from gsmerge.research.charts import series
from gsmerge.research.charts.experiment import OURS
from gsmerge.research.charts.figures import DIGITS, BreakEven, Curves, Figure, VerdictTable
from gsmerge.research.charts.markup import Cell, Row, details, inline_svg, table, text
from gsmerge.research.charts.pictures import error_section, find_pictures, slider_section
from gsmerge.research.charts.record import RunRecord
from gsmerge.research.charts.run import describe
from gsmerge.research.charts.series import PART_LABELS
from gsmerge.research.charts.statistics import Interval
from gsmerge.view.page import PICTURES, render_template

HEADS = {"psnr": "PSNR", "ssim": "SSIM", "lpips_vgg": "LPIPS VGG", "lpips_alex": "LPIPS Alex"}
KINDS = {"ours above": "above", "baseline above": "below"}  # of verdicts, as CSS classes


def make_page(
    records: Sequence[RunRecord],
    figures: Sequence[Figure],
    drawings: Mapping[str, str],
    verdicts: Sequence[VerdictTable],
    folder: Path,
    *,
    command: str,
) -> str:
    """The whole page; it loads nothing from the network, and its policy forbids that.

    ``drawings`` are the SVG of each figure by name; ``command`` is the command line that draws the page again.
    """
    done = series.successful(records)
    scenes = list(dict.fromkeys(record.scene for record in records))
    failed = [record for record in records if record.error is not None]
    pictures = find_pictures(done, folder)
    wholes = {figure.all_of: figure for figure in figures if isinstance(figure, Curves | BreakEven) and figure.all_of}
    shown = [figure for figure in figures if figure not in wholes.values()]
    sections = [
        ("results", "Results", _results(done)),
        ("verdicts", "At equal cost", _verdicts(verdicts)),
        *((figure.name, figure.title, _figure(figure, wholes, drawings, done, command)) for figure in shown),
        ("compare", "Side by side", slider_section(pictures)),
        ("errors", "Error maps", error_section(pictures)),
        ("failures", "Failed runs", _failures(failed)),
        ("runs", "All runs", _runs(done)),
        ("environment", "Environment", _environment(records, command)),
    ]
    sections = [section for section in sections if section[2]]
    names = ", ".join(scenes[:12]) + (", ..." if len(scenes) > 12 else "")
    words = f"{len(records)} runs on {len(scenes)} scene(s): {names}" + (f"; {len(failed)} failed" if failed else "")
    style = files("gsmerge.research.charts").joinpath("page.css").read_text(encoding="utf-8")
    return render_template(
        "charts.html", policy=PICTURES, title=f"gsmerge: {names}", words=words, style=style, sections=sections
    )


def _interval(value: Interval, digits: int) -> str:
    half = value.high - value.mean
    return f"{value.mean:.{digits}f}" + (f" ± {half:.{digits}f}" if value.count > 1 else "")


def _results(records: Sequence[RunRecord]) -> str:
    """Means over the scenes by method, settings and size."""
    if not records:
        return ""
    part = series.choose_part(records)
    metrics = series.list_metrics(records, part)
    views = series.typical_views(records)
    scores: dict[str, dict[tuple[str, str], Interval]] = {metric: {} for metric in metrics}
    for metric, means in scores.items():
        for line in series.by_size(records, lambda record: record.ratio, series.score_getter(metric, part)):
            means |= {(line.name, point.label): point.y for point in line.points}
    names, groups = series.names_of(records), dict[tuple[str, str], list[RunRecord]]()
    lines = list(names)
    for record in sorted(records, key=lambda r: (lines.index(series.line_key(r)), r.ratio or 0.0)):
        if record.views_asked == views:
            groups.setdefault((names[series.line_key(record)], series.size_label(record)), []).append(record)
    rows = []
    for (name, size), group in groups.items():
        cells = [
            _interval(means[name, size], DIGITS[metric]) if (name, size) in means else _plain(group, metric, part)
            for metric, means in scores.items()
        ]
        rows.append([name, size, str(len(group)), *_costs(group), *cells])
    head = ["Method", "Size", "Scenes", "Gaussians", "Kept", "File", "Seconds", "ms/view", *(HEADS[m] for m in metrics)]
    words = (
        f"Means over scenes, measured on {PART_LABELS[part]}; ± is half of a 95 % t interval of the differences between"
        " settings, without those between scenes. PSNR and SSIM: higher is better; LPIPS: lower."
    )
    ours = [i for i, row in enumerate(rows) if row[0].startswith(OURS)]
    return f"<p>{text(words)}</p>{table(head, rows, texts=(0, 1), ours=ours)}"


def _plain(group: Sequence[RunRecord], metric: str, part: str) -> str:
    mean = _mean([record.score(f"{metric}_{part}") for record in group])
    return "" if mean is None else f"{mean:.{DIGITS[metric]}f}"


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _costs(group: Sequence[RunRecord]) -> list[str]:
    """Count, share, bytes, seconds, render time."""
    names = ("count", "ratio", "bytes", "seconds", "render_ms")
    count, ratio, size, seconds, ms = (_mean([getattr(r, name) for r in group]) for name in names)
    return [
        "" if count is None else f"{count:,.0f}",
        "" if ratio is None else f"{100 * ratio:.2f} %",
        "" if size is None else human_bytes(size),
        "" if not seconds else f"{seconds:.2f}",
        "" if ms is None else f"{ms:.1f}",
    ]


def _verdicts(tables: Sequence[VerdictTable]) -> str:
    """Whether any baseline's point lies above ours, in a sentence, and the points."""
    parts = []
    for compared in tables:
        words = [verdict.words for _, verdict in compared.rows]
        above, digits = words.count("baseline above"), compared.decimals
        answer = f"{above} baseline point(s) lie above ours" if above else "no baseline's point lies above ours"
        sentence = (
            f"{compared.title}: {answer} ({len(words)} points; {words.count('ours above')} below ours,"
            f" {words.count('undecided')} undecided, {words.count('ours has none so cheap')} cheaper than anything of"
            " ours, so not compared)."
        )
        rows: list[Row] = []
        for label, verdict in compared.rows:
            ours = "" if verdict.ours is None else f"{verdict.ours:.{digits}f}"
            ahead = "" if verdict.ahead is None else _interval(verdict.ahead, digits)
            last = Cell(verdict.words, f"text {KINDS.get(verdict.words, '')}")
            cells = f"{verdict.cost:.4g}", f"{verdict.quality:.{digits}f}", ours, ahead
            rows.append([verdict.baseline, label, *cells, last])
        head = ["Baseline", "Size", "Cost", "Quality", "Ours there", "Ours ahead by", "Verdict"]
        parts.append(f"<p>{text(sentence)}</p>" + details("the points", table(head, rows, texts=(0, 1, 6))))
    if not parts:
        return ""
    how = (
        "Each point of a baseline compared with our curve at the same cost: our front, linear over the logarithm of the"
        " cost, scene by scene; a side is named where the 95 % interval of the paired difference excludes zero."
    )
    return f'<p class="muted">{text(how)}</p>{"".join(parts)}'


def _figure(
    figure: Figure, wholes: Mapping[str, Figure], drawings: Mapping[str, str], records: Sequence[RunRecord],
    command: str,
) -> str:  # fmt: skip
    """A figure, all its lines behind a toggle where it shows the main ones, its numbers, and the commands."""
    whole = wholes.get(figure.name)
    rest = "" if whole is None else details("all lines", _drawing(whole, drawings))
    numbers = whole or figure
    points = _points(numbers) if isinstance(numbers, Curves) else ""
    return f"{_drawing(figure, drawings)}{rest}{points}{details('commands', _commands(records, command))}"


def _drawing(figure: Figure, drawings: Mapping[str, str]) -> str:
    svg = inline_svg(drawings[figure.name], figure.name, f"{figure.title}. {figure.caption}")
    return f"<figure>{svg}<figcaption>{text(figure.caption)}</figcaption></figure>"


def _commands(records: Sequence[RunRecord], command: str) -> str:
    """The command lines of the runs, each once, and the one that draws the page."""
    runs = list(dict.fromkeys(record.command for record in records if record.command))
    return f"<pre>{text(chr(10).join([*runs, command]))}</pre>"


def _points(figure: Curves) -> str:
    """The numbers of a figure."""
    rows: list[Row] = [
        [panel.y_label, line.name, point.label, f"{point.x:.4g}", *(f"{y:.5g}" for y in astuple(point.y)[:3])]
        for panel in figure.panels
        for line in panel.lines
        for point in line.points
    ]
    head = ["Panel", "Line", "Point", figure.x_label if not figure.percent else "Share kept", "Mean", "Low", "High"]
    return details("numbers", table(head, rows, texts=(0, 1, 2)))


def _failures(failed: Sequence[RunRecord]) -> str:
    rows: list[Row] = [[r.scene, describe(r), Cell(r.error or "", "long")] for r in failed]
    return table(["Scene", "Run", "Error"], rows, texts=(0, 1, 2)) if rows else ""


def _runs(records: Sequence[RunRecord]) -> str:
    """One row for each run."""
    if not records:
        return ""
    columns = [(m, p) for p in PART_LABELS for m in HEADS if any(r.score(f"{m}_{p}") is not None for r in records)]
    rows = []
    for record in records:
        scores = [record.score(f"{metric}_{part}") for metric, part in columns]
        cells = ["" if v is None else f"{v:.{DIGITS[m]}f}" for v, (m, _) in zip(scores, columns, strict=True)]
        rows.append([record.scene, describe(record), str(record.views), *_costs([record]), *cells])
    head = ["Scene", "Run", "Views", "Gaussians", "Kept", "File", "Seconds", "ms/view"]
    head += [f"{HEADS[metric]} {part.replace('_', ', ')}" for metric, part in columns]
    return details(f"{len(rows)} runs", table(head, rows, texts=(0, 1)))


def _environment(records: Sequence[RunRecord], command: str) -> str:
    """The machines of the runs, each once, and all commands."""
    machines = list(dict.fromkeys(tuple(record.environment.items()) for record in records))
    tables = [table(["", ""], [[name, value] for name, value in machine], texts=(0, 1)) for machine in machines]
    return "".join(tables) + _commands(records, command)
