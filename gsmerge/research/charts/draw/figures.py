"""Drawing each kind of figure: one column of a paper, colours that the colour-blind tell apart (Okabe and Ito 2008)."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as MplFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullFormatter, NullLocator

from gsmerge.research.charts import figures
from gsmerge.research.charts.experiment import OURS
from gsmerge.research.charts.record import INPUT
from gsmerge.research.charts.series import Line
from gsmerge.research.charts.statistics import pareto_front

PANEL_WIDTH, SINGLE_WIDTH, HEIGHT = 2.9, 4.4, 2.5  # inches: one of several panels, the only panel
KEY_WIDTH, KEY_LINE, KEY_FONT = 2.3, 0.135, 7  # of the key: inches, inches per line, points
SAME_COST = 1.02  # costs that differ by less than this factor count as one
MIN_SCENES = 3  # scenes that an interval is drawn from; that of two scenes is too wide to be of use
MARGIN = 0.12  # share of the range of the means, above and below

INK, MUTED, GRID = "#222222", "#6b6b6b", "#e6e6e6"
STAGE_COLORS = ("#0072B2", "#56B4E9", "#009E73", "#F0E442", "#E69F00", "#D55E00", "#CC79A7", "#999999")
OUR_COLORS = ("#0072B2", "#56B4E9", "#003F66", "#7FA8C9", "#2E5C8A", "#9FC5E8")
OUR_DASHES: tuple[Any, ...] = ("-", (0, (4, 1.5)), (0, (1, 1.2)), (0, (5, 1, 1, 1)), "-", (0, (4, 1.5)))
BASELINE_COLORS = ("#D55E00", "#009E73", "#CC79A7", "#E69F00", "#7B4173", "#8C6D31")
BASELINE_DASHES: tuple[Any, ...] = ("-", (0, (4, 1.5)), (0, (1, 1.2)))  # the next for every round through the colours
OUR_MARKERS, BASELINE_MARKERS = "osDvPX*", "^vD<>XP"  # as many as leave no divisor in common with the colours
_TICKS = {"color": MUTED, "labelcolor": INK, "labelsize": 7, "major.size": 2.5, "major.width": 0.6}
RC: dict[Any, Any] = {
    "axes.edgecolor": MUTED,
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "figure.dpi": 100,
    "font.family": "DejaVu Sans",
    "font.size": 7.5,
    "grid.color": GRID,
    "grid.linewidth": 0.5,
    "savefig.dpi": 300,
    "svg.fonttype": "path",
    "svg.hashsalt": "gsmerge",
    "text.color": INK,
    **{f"{axis}tick.{name}": value for axis in "xy" for name, value in _TICKS.items()},
}


@dataclass(frozen=True)
class LineStyle:
    """How a line is drawn."""

    color: str
    dash: Any
    marker: str
    width: float
    order: int


Styles = Mapping[str, LineStyle]
INPUT_STYLE = LineStyle("#555555", (0, (2, 2)), "s", 1.0, 2)
REFERENCE_STYLE = LineStyle(INPUT_STYLE.color, INPUT_STYLE.dash, "", 0.9, 1)


def line_styles(names: Sequence[tuple[str, bool]]) -> dict[str, LineStyle]:
    """A style for every line by its name and whether it is ours: ours blue and in front, each baseline its own."""
    styles: dict[str, LineStyle] = {}
    ours = baselines = 0
    for name, is_ours in names:
        if name == INPUT:
            styles[name] = INPUT_STYLE
        elif is_ours:
            i = ours % len(OUR_COLORS)
            width, order = 1.6 if ours == 0 else 1.2, 6 - min(ours, 2)
            marker = OUR_MARKERS[ours % len(OUR_MARKERS)]
            styles[name] = LineStyle(OUR_COLORS[i], OUR_DASHES[i], marker, width, order)
            ours += 1
        else:
            dash = BASELINE_DASHES[baselines // len(BASELINE_COLORS) % len(BASELINE_DASHES)]
            marker = BASELINE_MARKERS[baselines % len(BASELINE_MARKERS)]
            styles[name] = LineStyle(BASELINE_COLORS[baselines % len(BASELINE_COLORS)], dash, marker, 1.1, 3)
            baselines += 1
    return styles


def common_styles(several: Sequence[figures.Figure]) -> Styles:
    """The styles of the lines of the curves with the most, for all figures that have no others."""
    curves = [_names(figure) for figure in several if isinstance(figure, figures.Curves)]
    return line_styles(max(curves, key=len, default=[]))


def _names(figure: figures.Figure) -> list[tuple[str, bool]]:
    """The lines of a figure and whether they are ours."""
    if isinstance(figure, figures.Curves):
        return [(INPUT, False), *dict.fromkeys((line.name, line.ours) for p in figure.panels for line in p.lines)]
    rows = figure.rows if isinstance(figure, figures.Bars) else [name for name, *_ in figure.rows]
    return [(INPUT, False), *((name, name.startswith(OURS)) for name in rows)]


def draw(figure: figures.Figure, common: Styles) -> tuple[bytes, bytes]:
    """A figure as PNG and SVG; the same numbers give the same bytes. ``common`` styles are used if complete."""
    names = _names(figure)
    styles = common if all(name in common for name, _ in names) else line_styles(names)
    with matplotlib.rc_context():
        matplotlib.rcdefaults()  # independent of the user's own settings
        matplotlib.rcParams.update(RC)
        if isinstance(figure, figures.Curves):
            fig = _draw_curves(figure, styles)
        elif isinstance(figure, figures.Bars):
            fig = _draw_bars(figure)
        else:
            fig = _draw_break_even(figure, styles)
        png, svg = io.BytesIO(), io.BytesIO()
        fig.savefig(png, format="png", metadata={"Software": None})
        fig.savefig(svg, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return png.getvalue(), svg.getvalue()


def _subplots(num_panels: int, height: float = HEIGHT) -> tuple[MplFigure, list[Axes]]:
    width = SINGLE_WIDTH if num_panels == 1 else PANEL_WIDTH * num_panels
    fig = MplFigure(figsize=(width, height), layout=ConstrainedLayoutEngine(w_pad=0.08))
    return fig, list(np.atleast_1d(fig.subplots(1, num_panels)))


def _add_key(fig: MplFigure, entries: Sequence[tuple[str, LineStyle]]) -> None:
    """The names of the lines, right of all panels; the figure grows by its size."""
    handles = [
        Line2D([], [], color=s.color, linestyle=s.dash, marker=s.marker, markersize=4, linewidth=s.width)
        for _, s in entries
    ]
    width, height = fig.get_size_inches()
    fig.set_size_inches(width + KEY_WIDTH, max(height, KEY_LINE * len(entries)))
    fig.legend(
        handles, [name for name, _ in entries], loc="outside right center", fontsize=KEY_FONT, frameon=False,
        handlelength=2.6, labelspacing=0.15, borderpad=0, labelcolor=[style.color for _, style in entries],
    )  # fmt: skip


def _draw_curves(figure: figures.Curves, styles: Styles) -> MplFigure:
    fig, all_axes = _subplots(len(figure.panels))
    key, references = dict[str, LineStyle](), dict[str, LineStyle]()
    for axes, panel in zip(all_axes, figure.panels, strict=True):
        _set_axes(axes, figure, panel)
        for line in panel.lines:
            _draw_line(axes, line, styles[line.name])
            key[line.name] = styles[line.name]
        if panel.reference is not None:
            name, level = panel.reference
            references[name] = style = REFERENCE_STYLE
            axes.axhline(level, color=style.color, linewidth=style.width, linestyle=style.dash, zorder=style.order)
        if figure.front:
            _mark_front(axes, panel)
    _add_key(fig, [*key.items(), *references.items()])
    return fig


def _set_axes(axes: Axes, figure: figures.Curves, panel: figures.Panel) -> None:
    """Limits, scales and labels."""
    xs = [p.x for line in panel.lines for p in line.points]
    ys = [p.y.mean for line in panel.lines for p in line.points]
    ys += [] if panel.reference is None else [panel.reference[1]]
    if figure.x_scale == "log":
        _log_axis(axes, "x", min(xs) / 1.25, max(xs) * 1.25, percent=figure.percent)
    else:
        room = 0.06 * (max(xs) - min(xs) or 1)
        axes.set_xlim(min(xs) - room, max(xs) + 2 * room)
        ticks = sorted(set(xs))
        axes.xaxis.set_major_locator(FixedLocator(ticks) if len(ticks) <= 8 else MaxNLocator(8, integer=True))
    if figure.y_scale == "log":
        _log_axis(axes, "y", min(ys) / 1.6, max(ys) * 1.6)
    else:
        room = MARGIN * (max(ys) - min(ys) or 1)
        axes.set_ylim(min(ys) - room, max(ys) + room)
        axes.yaxis.set_major_locator(MaxNLocator(6))
    arrow = "" if figure.y_scale == "log" else " ↑" if panel.higher else " ↓"
    axes.set(xlabel=figure.x_label, ylabel=panel.y_label + arrow, axisbelow=True)


def _draw_line(axes: Axes, line: Line, style: LineStyle) -> None:
    x, y = [p.x for p in line.points], [p.y.mean for p in line.points]
    low, high = [p.y.low for p in line.points], [p.y.high for p in line.points]
    known = min(p.y.count for p in line.points) >= MIN_SCENES and low != high
    if known and len(x) > 1:
        axes.fill_between(x, low, high, color=style.color, alpha=0.13, linewidth=0, zorder=style.order - 1)
    elif known:
        axes.vlines(x, low, high, color=style.color, alpha=0.35, linewidth=2.5, zorder=style.order - 1)
    axes.plot(
        x, y, color=style.color, linestyle=style.dash, linewidth=style.width, marker=style.marker, markersize=3.6,
        markeredgecolor="white", markeredgewidth=0.5, zorder=style.order,
    )  # fmt: skip


def _mark_front(axes: Axes, panel: figures.Panel) -> None:
    """Rings around the points of the Pareto front, and the steps between them."""
    points = [p for line in panel.lines for p in line.points]
    sign = 1 if panel.higher else -1
    costs = [round(math.log(p.x) / math.log(SAME_COST)) for p in points]
    front = [points[i] for i in pareto_front(costs, [sign * p.y.mean for p in points])]
    x, y = [p.x for p in front], [p.y.mean for p in front]
    axes.plot(x, y, color="#c9c9c9", linewidth=4.5, solid_capstyle="round", zorder=1, alpha=0.6)
    axes.plot(x, y, "o", markersize=6.4, markerfacecolor="none", markeredgecolor=INK, markeredgewidth=0.6, zorder=8)


def log_ticks(low: float, high: float) -> list[float]:
    """Round numbers between two positive ones: 1, 2 and 5 of every decade, or 1 alone where that would be many."""
    decades = range(-12, 13)
    fine = [m * 10.0**e for e in decades for m in (1, 2, 5) if low <= m * 10.0**e * 1.0000001 and m * 10.0**e <= high]
    return fine if len(fine) <= 8 else [10.0**e for e in decades if low <= 10.0**e <= high]


def format_tick(value: float) -> str:
    """A tick's number, with k and M for thousands and millions."""
    for factor, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= factor * 0.9999999:
            return f"{value / factor:g}{letter}"
    return f"{value:g}"


def _log_axis(axes: Axes, which: str, low: float, high: float, *, percent: bool = False) -> None:
    """A logarithmic axis from low to high with round ticks."""
    axes.set(**{f"{which}scale": "log", f"{which}lim": (low, high)})
    axis = axes.xaxis if which == "x" else axes.yaxis
    factor = 100 if percent else 1
    axis.set_major_locator(FixedLocator([t / factor for t in log_ticks(low * factor, high * factor)]))
    axis.set_major_formatter(FuncFormatter(lambda value, _: format_tick(round(value * factor, 9))))
    axis.set_minor_locator(NullLocator())
    axis.set_minor_formatter(NullFormatter())


def _draw_bars(figure: figures.Bars) -> MplFigure:
    rows = len(figure.rows)
    fig, (axes,) = _subplots(1, 0.75 + 0.3 * max(rows, 2))
    left = np.zeros(rows)
    for i, (stage, seconds) in enumerate(figure.stages.items()):
        color = "#bbbbbb" if stage == "other" else STAGE_COLORS[i % len(STAGE_COLORS)]
        axes.barh(range(rows), seconds, 0.62, left, color=color, edgecolor="white", linewidth=0.6, label=stage)
        left += np.array(seconds)
    for row, total in enumerate(left):
        axes.text(total + 0.012 * left.max(), row, _format_seconds(float(total)), va="center")
    axes.set_yticks(range(rows), figure.rows)
    axes.set_ylim(rows - 0.5, -0.5)
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.set(xlim=(0, 1.12 * left.max()), xlabel="Seconds", axisbelow=True)
    fig.legend(
        loc="outside upper center", ncols=min(len(figure.stages), 7), frameon=False, fontsize=7, handlelength=0.9,
        handleheight=0.9, columnspacing=1.0, handletextpad=0.4,
    )  # fmt: skip
    return fig


def _format_seconds(value: float) -> str:
    return f"{value:.0f} s" if value >= 10 else f"{value:.1f} s" if value >= 1 else f"{value:.2f} s"


def _draw_break_even(figure: figures.BreakEven, styles: Styles) -> MplFigure:
    fig, (axes,) = _subplots(1)
    even = [frames for *_, frames in figure.rows if frames is not None]
    last = 10 ** math.ceil(math.log10(max([30.0, *even]) * 2))
    first = 10 ** math.floor(math.log10(max(1.0, min([10.0, *even]) / 3)))
    frames = np.geomspace(first, last, 120)
    rows = [(INPUT, 0.0, figure.input_ms, None), *figure.rows]
    totals = [seconds + frames * ms / 1000 for _, seconds, ms, _ in rows]
    key = []
    for (name, _, _, at), total in zip(rows, totals, strict=True):
        style = styles[name]
        axes.plot(frames, total, color=style.color, linestyle=style.dash, linewidth=style.width, zorder=style.order)
        if at is not None:
            spot = at * figure.input_ms / 1000
            edge: dict[str, Any] = {"markersize": 5.5, "markeredgecolor": "white", "markeredgewidth": 0.5}
            axes.plot([at], [spot], style.marker, color=style.color, zorder=8, **edge)
        when = "" if name == INPUT else ": never" if at is None else f": {math.ceil(at):,} frames"
        key.append((name + when, style if at is not None else replace(style, marker="")))
    _log_axis(axes, "x", first, last)
    _log_axis(axes, "y", float(np.min(totals)) / 1.3, float(np.max(totals)) * 1.3)
    axes.set(xlabel="Frames rendered", ylabel="Seconds, merge included")
    _add_key(fig, key)
    return fig
