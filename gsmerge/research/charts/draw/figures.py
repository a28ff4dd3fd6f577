"""Drawing each kind of figure."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, MaxNLocator

from gsmerge.research.charts import figures
from gsmerge.research.charts.draw import style
from gsmerge.research.charts.draw.labels import SIZE, Label, end_labels, place_labels, settle
from gsmerge.research.charts.experiment import OURS
from gsmerge.research.charts.record import INPUT
from gsmerge.research.charts.series import Line
from gsmerge.research.charts.statistics import pareto_front

PANEL_WIDTH, HEIGHT = 2.9, 2.5  # inches
SINGLE_WIDTH = 4.4
KEY_WIDTH, KEY_LINE = 2.3, 0.135  # inches: of the key, and for each of its lines
CROWDED = 10  # names beside their lines: more would lie over one another
SAME_COST = 1.02  # costs that differ by less than this factor are drawn as one
FEWEST = 3  # scenes that a band is drawn from; two say next to nothing
MARGIN = 0.12  # of the range of the means, above and below
STAGE_COLORS = ("#0072B2", "#56B4E9", "#009E73", "#F0E442", "#E69F00", "#D55E00", "#CC79A7", "#999999")


Looks = Mapping[str, style.Look]


def common_looks(several: Sequence[figures.Figure]) -> Looks:
    """The looks of the first figure's lines, for all figures that show no others."""
    return style.looks(next((_names(figure) for figure in several if isinstance(figure, figures.Curves)), []))


def _names(figure: figures.Figure) -> list[tuple[str, bool]]:
    """The lines of a figure and whether they are ours."""
    if isinstance(figure, figures.Curves):
        return [(INPUT, False), *dict.fromkeys((line.name, line.ours) for p in figure.panels for line in p.lines)]
    rows = figure.rows if isinstance(figure, figures.Bars) else [name for name, *_ in figure.rows]
    return [(INPUT, False), *((name, name.startswith(OURS)) for name in rows)]


def draw(figure: figures.Figure, common: Looks) -> tuple[bytes, bytes]:
    """A figure as PNG and SVG; the same numbers give the same bytes.

    Args:
        figure: What to draw.
        common: Looks of lines, taken if they have all of the figure's.
    """
    names = _names(figure)
    looks = common if all(name in common for name, _ in names) else style.looks(names)
    with matplotlib.rc_context():
        matplotlib.rcdefaults()  # whatever the user's own style is
        matplotlib.rcParams.update(style.RC)
        if isinstance(figure, figures.Curves):
            canvas = _draw_curves(figure, looks)
        elif isinstance(figure, figures.Bars):
            canvas = _draw_bars(figure)
        else:
            canvas = _draw_payback(figure, looks)
        png, svg = io.BytesIO(), io.BytesIO()
        canvas.savefig(png, format="png", metadata={"Software": None})
        canvas.savefig(svg, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return png.getvalue(), svg.getvalue()


def _canvas(num_panels: int, height: float = HEIGHT) -> tuple[Canvas, list[Axes]]:
    width = SINGLE_WIDTH if num_panels == 1 else PANEL_WIDTH * num_panels
    canvas = Canvas(figsize=(width, height), layout=ConstrainedLayoutEngine(w_pad=0.08))
    return canvas, list(np.atleast_1d(canvas.subplots(1, num_panels)))


def _lay_out(canvas: Canvas) -> None:
    """Decide all places once, so that those in pixels are known and stay."""
    canvas.draw_without_rendering()
    canvas.set_layout_engine("none")


def _draw_curves(figure: figures.Curves, looks: Looks) -> Canvas:
    canvas, all_axes = _canvas(len(figure.panels))
    for axes, panel in zip(all_axes, figure.panels, strict=True):
        _axes(axes, figure, panel)
        for line in panel.lines:
            _line(axes, line, looks[line.name])
        if panel.reference is not None:
            axes.axhline(panel.reference[1], color=style.INPUT_COLOR, linewidth=0.9, linestyle=(0, (2, 2)), zorder=1)
        if figure.front:
            _mark_front(axes, panel)
    first, last = all_axes[0], all_axes[-1]
    labels = _labels(last, figure.panels[-1], looks)
    names = end_labels(last, labels)  # one panel has the names for all
    crowded = not names and len(labels) > CROWDED
    if crowded:
        _key(canvas, labels, looks)
    _lay_out(canvas)
    if names:
        settle(last, labels, names)
    elif not crowded:
        place_labels(first, _labels(first, figure.panels[0], looks))
    return canvas


def _key(canvas: Canvas, labels: Sequence[Label], looks: Looks) -> None:
    """The names right of all panels, with their lines, where there are too many to stand beside them."""
    handles = []
    for label in labels:
        look = looks.get(label.text)
        dash, marker, width = (look.dash, look.marker, look.width) if look else ((0, (2, 2)), "", 0.9)
        handles.append(Line2D([], [], color=label.color, linestyle=dash, marker=marker, markersize=4, linewidth=width))
    width, height = canvas.get_size_inches()
    canvas.set_size_inches(width + KEY_WIDTH, max(height, KEY_LINE * len(labels)))
    canvas.legend(
        handles, [label.text for label in labels], loc="outside right center", fontsize=SIZE, frameon=False,
        handlelength=2.6, labelspacing=0.15, borderpad=0, labelcolor=[label.color for label in labels],
    )  # fmt: skip


def _labels(axes: Axes, panel: figures.Panel, looks: Looks) -> list[Label]:
    labels = [
        Label(line.name, looks[line.name].color, np.array([[p.x, p.y.mean] for p in line.points]))
        for line in panel.lines
    ]
    if panel.reference is not None:
        name, level = panel.reference
        inner = np.geomspace(axes.get_xlim()[0], max(p.x for line in panel.lines for p in line.points), 9)[1:]
        labels.append(Label(name, style.INPUT_COLOR, np.array([[x, level] for x in inner])))
    return labels


def _axes(axes: Axes, figure: figures.Curves, panel: figures.Panel) -> None:
    """Limits, scales and words."""
    xs = [p.x for line in panel.lines for p in line.points]
    ys = [p.y.mean for line in panel.lines for p in line.points]
    ys += [] if panel.reference is None else [panel.reference[1]]
    if figure.x_scale == "log":
        style.log_axis(axes, "x", min(xs) / 1.25, max(xs) * 1.25, percent=figure.percent)
    else:
        room = 0.06 * (max(xs) - min(xs) or 1)
        axes.set_xlim(min(xs) - room, max(xs) + 2 * room)
        axes.xaxis.set_major_locator(
            FixedLocator(sorted(set(xs))) if len(set(xs)) <= 8 else MaxNLocator(8, integer=True)
        )
    if figure.y_scale == "log":
        style.log_axis(axes, "y", min(ys) / 1.6, max(ys) * 1.6)
    else:
        room = MARGIN * (max(ys) - min(ys) or 1)
        axes.set_ylim(min(ys) - room, max(ys) + room)
        axes.yaxis.set_major_locator(MaxNLocator(6))
    axes.set_xlabel(figure.x_label)
    arrow = "" if figure.y_scale == "log" else " ↑" if panel.higher else " ↓"
    axes.set_ylabel(panel.y_label + arrow)
    axes.set_axisbelow(True)


def _line(axes: Axes, line: Line, look: style.Look) -> None:
    x, y = [p.x for p in line.points], [p.y.mean for p in line.points]
    low, high = [p.y.low for p in line.points], [p.y.high for p in line.points]
    known = min(p.y.count for p in line.points) >= FEWEST and low != high
    if known and len(x) > 1:
        axes.fill_between(x, low, high, color=look.color, alpha=0.13, linewidth=0, zorder=look.order - 1)
    elif known:
        axes.vlines(x, low, high, color=look.color, alpha=0.35, linewidth=2.5, zorder=look.order - 1)
    axes.plot(
        x, y, color=look.color, linestyle=look.dash, linewidth=look.width, marker=look.marker, markersize=3.6,
        markeredgecolor="white", markeredgewidth=0.5, zorder=look.order,
    )  # fmt: skip


def _mark_front(axes: Axes, panel: figures.Panel) -> None:
    """Rings around the points that no other beats, and the steps between them."""
    points = [p for line in panel.lines for p in line.points]
    sign = 1 if panel.higher else -1
    costs = [round(math.log(p.x) / math.log(SAME_COST)) for p in points]
    front = [points[i] for i in pareto_front(costs, [sign * p.y.mean for p in points])]
    x, y = [p.x for p in front], [p.y.mean for p in front]
    axes.plot(x, y, color="#c9c9c9", linewidth=4.5, solid_capstyle="round", zorder=1, alpha=0.6)
    axes.plot(
        x, y, "o", markersize=6.4, markerfacecolor="none", markeredgecolor=style.INK, markeredgewidth=0.6, zorder=8
    )


def _draw_bars(figure: figures.Bars) -> Canvas:
    rows = len(figure.rows)
    canvas, (axes,) = _canvas(1, 0.75 + 0.3 * max(rows, 2))
    left = np.zeros(rows)
    for i, (stage, seconds) in enumerate(figure.stages.items()):
        color = "#bbbbbb" if stage == "other" else STAGE_COLORS[i % len(STAGE_COLORS)]
        axes.barh(
            range(rows), seconds, left=left, height=0.62, color=color, edgecolor="white", linewidth=0.6, label=stage
        )
        left += np.array(seconds)
    for row, total in enumerate(left):
        axes.text(total + 0.012 * left.max(), row, _seconds(float(total)), va="center")
    axes.set_yticks(range(rows), figure.rows)
    axes.set_ylim(rows - 0.5, -0.5)
    axes.set_xlim(0, 1.12 * left.max())
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.set_xlabel("Seconds")
    axes.set_axisbelow(True)
    canvas.legend(
        loc="outside upper center", ncols=min(len(figure.stages), 7), frameon=False, fontsize=7, handlelength=0.9,
        handleheight=0.9, columnspacing=1.0, handletextpad=0.4,
    )  # fmt: skip
    return canvas


def _seconds(value: float) -> str:
    return f"{value:.0f} s" if value >= 10 else f"{value:.1f} s" if value >= 1 else f"{value:.2f} s"


def _draw_payback(figure: figures.Payback, looks: Looks) -> Canvas:
    canvas, (axes,) = _canvas(1)
    even = [frames for *_, frames in figure.rows if frames is not None]
    last = 10 ** math.ceil(math.log10(max([30.0, *even]) * 2))
    first = 10 ** math.floor(math.log10(max(1.0, min([10.0, *even]) / 3)))
    frames = np.geomspace(first, last, 120)
    totals = {INPUT: frames * figure.input_ms / 1000}
    totals |= {name: seconds + frames * ms / 1000 for name, seconds, ms, _ in figure.rows}
    for name, total in totals.items():
        look = looks[name]
        axes.plot(frames, total, color=look.color, linestyle=look.dash, linewidth=look.width, zorder=look.order)
    for name, _, _, at in figure.rows:
        if at is not None:
            spot = at * figure.input_ms / 1000
            axes.plot([at], [spot], "o", color=looks[name].color, markersize=5, markeredgecolor="white", zorder=8)
    style.log_axis(axes, "x", first, last)
    spread = np.concatenate(list(totals.values()))
    style.log_axis(axes, "y", float(spread.min()) / 1.3, float(spread.max()) * 1.3)
    axes.set_xlabel("Frames rendered")
    axes.set_ylabel("Seconds, merge included")
    _lay_out(canvas)
    spots = np.linspace(8, len(frames) - 12, 14).astype(int)
    labels = []
    for name, total in totals.items():
        curve = np.stack([frames, total], 1)
        labels.append(Label(_with_frames(name, figure), looks[name].color, curve, curve[spots]))
    place_labels(axes, labels)
    return canvas


def _with_frames(name: str, figure: figures.Payback) -> str:
    """A name with the number of frames after which it is even."""
    at: Sequence[float | None] = [frames for row, _, _, frames in figure.rows if row == name]
    if not at:
        return name
    return f"{name}: never" if at[0] is None else f"{name}: {math.ceil(at[0]):,} frames"


__all__ = ["draw"]
