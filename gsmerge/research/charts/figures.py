"""Draw figures of runs in one style, with colours that colour-blind people can distinguish."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from gsmerge.frozen import dataclass
from gsmerge.io import atomic_output
from gsmerge.research.charts.lines import CHART_METRICS, MIN_SCENES, PARTS, Line, Results
from gsmerge.research.charts.measure_run import INPUT

# inches: one of several panels, the only panel
PANEL_WIDTH = 2.9
SINGLE_WIDTH = 4.4
PANEL_HEIGHT = 2.5
# The first six colours are those of Okabe and Ito (2008)
LINE_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7B4173", "#8C6D31")
MARKERS = "osD^vPX"  # 7 markers and 8 colours, so 56 lines have different pairs of marker and colour
DASHES: tuple[Any, ...] = ("-", (0, (4, 1.5)), (0, (1, 1.2)))  # the first 8 lines have the first dash, and so on
RC: dict[Any, Any] = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.xmargin": 0.06,
    "axes.ymargin": 0.12,
    "font.size": 7.5,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.5,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "savefig.dpi": 300,
    "svg.hashsalt": "gsmerge",
    **{
        f"{axis}tick.{name}": 7 if name == "labelsize" else 2.5 for axis in "xy" for name in ("labelsize", "major.size")
    },
}


@dataclass(frozen=True)
class Panel:
    """One pair of axes with lines."""

    y_label: str  # with unit
    higher: bool  # True if higher is better
    lines: tuple[Line, ...]
    reference: float | None = None  # value of the input


@dataclass(frozen=True)
class Chart:
    """A chart and its table: lines over a common x."""

    name: str  # name of its files
    title: str  # title of its section
    caption: str
    x_label: str  # with unit
    head: tuple[str, ...]  # head of the table of its numbers
    rows: tuple[tuple[str, ...], ...]  # rows of this table
    panels: tuple[Panel, ...]  # side by side


def make_figures(results: Results) -> list[Chart]:
    """Make the figures for which there are runs: quality against time, and quality against size."""
    time = "Quality against time", "the wall time of the merge (reading and writing not counted)", "Seconds"
    size = "Quality against size", "the share of the input's Gaussians that is kept", "Gaussians kept (%)"
    figures = [
        _plot_against(results, "seconds", "quality-seconds", *time),
        _plot_against(results, "percent", "quality-ratio", *size),
    ]
    return [figure for figure in figures if figure is not None]


def _plot_against(results: Results, cost: str, name: str, title: str, cost_words: str, x_label: str) -> Chart | None:
    """Plot quality against a cost, with a panel for each metric and a table of all points.

    ``cost`` is the name of a value of a record, and ``cost_words`` describe the cost in the caption. Returns None if no
    run has the cost.
    """
    panels = []
    for metric in results.metrics:
        score = f"{metric}_{results.part}"
        lines = results.by_size(cost, score)
        scenes = {scene for line in lines for point in line.points for scene in point.by_scene}
        y_label = CHART_METRICS[metric].label
        higher = CHART_METRICS[metric].higher
        if lines:
            panels.append(Panel(y_label, higher, tuple(lines), results.input_mean(score, scenes)))
    if not panels:
        return None
    rows = []
    for panel in panels:
        for line in panel.lines:
            for point in line.points:
                # A mean and the ends of its interval, which are empty if the scenes are too few
                numbers = [point.y.mean, *([point.y.low, point.y.high] if point.y.count >= MIN_SCENES else [])]
                words = [f"{value:.5g}" for value in numbers] + [""] * (3 - len(numbers))
                rows.append((panel.y_label, line.name, point.label, f"{point.x:.4g}", *words))
    head = ("Panel", "Line", "Point", x_label, "Mean", "Low", "High")
    shown = sorted({scene for line in panels[0].lines for point in line.points for scene in point.by_scene})
    max_named = 8  # most scenes that a caption names
    listed = f"{', '.join(shown[:max_named])}{', ...' if len(shown) > max_named else ''}"
    about = f"Scene: {listed}; one scene has no intervals."
    if len(shown) > 1:
        about = (
            f"Means over {len(shown)} scenes ({listed}); bands, from three scenes on: 95 % t intervals of the"
            " differences between settings, without those between scenes."
        )
    caption = f"{results.caveat}Quality against {cost_words}. Measured on {PARTS[results.part]}. {about}"
    return Chart(name, title=title, caption=caption, x_label=x_label, head=head, rows=tuple(rows), panels=tuple(panels))


def draw_figures(figures: Sequence[Chart], folder: Path) -> dict[str, bytes]:
    """Draw figures to ``NAME.png`` and ``NAME.svg`` in a folder, and return the SVGs by name.

    Equal numbers give equal bytes.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = dict.fromkeys((line.name, line.is_own) for f in figures for panel in f.panels for line in panel.lines)
    drawn = {}
    styles = line_styles(names)
    for figure in figures:
        with matplotlib.rc_context():
            matplotlib.rcdefaults()  # the user's own settings have no effect
            matplotlib.rcParams.update(RC)
            drawing = draw_curves(figure, styles)
            # Dates and versions in the metadata would make equal figures differ
            for suffix, omitted in (("png", ("Software",)), ("svg", ("Date", "Creator", "Format", "Type"))):
                data = io.BytesIO()
                drawing.savefig(data, format=suffix, metadata=dict.fromkeys(omitted))
                with atomic_output(folder / f"{figure.name}.{suffix}", overwrite=True) as temporary:
                    temporary.write_bytes(data.getvalue())
        drawn[figure.name] = data.getvalue()
    return drawn


Style = dict[str, Any]  # arguments of matplotlib for a line


def line_styles(names: Iterable[tuple[str, bool]]) -> dict[str, Style]:
    """Choose a style for each line, by its name; gsmerge's own lines are broader and in front."""
    styles: dict[str, Style] = {INPUT: {"color": "#555555", "ls": (0, (2, 2)), "marker": "s", "lw": 1.0, "zorder": 2}}
    for i, (name, is_own) in enumerate(line for line in names if line[0] != INPUT):
        dash = DASHES[i // len(LINE_COLORS) % len(DASHES)]
        marks = {"color": LINE_COLORS[i % len(LINE_COLORS)], "ls": dash, "marker": MARKERS[i % len(MARKERS)]}
        styles[name] = {**marks, "lw": 1.5 if is_own else 1.1, "zorder": 4 + is_own}
    return styles


def draw_curves(figure: Chart, styles: Mapping[str, Style]) -> Drawing:
    """Draw a figure's panels side by side, with one legend beside them."""
    num_panels = len(figure.panels)
    # width of the legend, and height of its lines, inches
    legend_width = 2.3
    legend_line = 0.135
    width = (SINGLE_WIDTH if num_panels == 1 else PANEL_WIDTH * num_panels) + legend_width
    names = list(dict.fromkeys(line.name for panel in figure.panels for line in panel.lines))
    names += [INPUT] * (INPUT not in names and any(panel.reference is not None for panel in figure.panels))
    size = width, max(PANEL_HEIGHT, legend_line * len(names))
    drawing = Drawing(figsize=size, layout=ConstrainedLayoutEngine(w_pad=0.08))
    all_axes = np.atleast_1d(drawing.subplots(1, num_panels))
    for axes, panel in zip(all_axes, figure.panels, strict=True):
        for line in panel.lines:
            _draw_line(axes, line, styles[line.name])
        if panel.reference is not None:
            axes.axhline(panel.reference, **{**styles[INPUT], "marker": ""})
        arrow = " ↑" if panel.higher else " ↓"
        axes.set(xlabel=f"{figure.x_label}, log scale", ylabel=panel.y_label + arrow, xscale="log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.9g}"))
        axes.xaxis.set_minor_locator(NullLocator())
    drawing.legend(
        [Line2D([], [], markersize=4, **styles[name]) for name in names], [name.replace("$", r"\$") for name in names],
        loc="outside right center", handlelength=2.6, labelspacing=0.15, borderpad=0,
    )  # fmt: skip
    return drawing


def _draw_line(axes: Axes, line: Line, style: Style) -> None:
    """Draw a line, with a band of intervals if there are enough scenes."""
    x = [p.x for p in line.points]
    y = [p.y.mean for p in line.points]
    low = [p.y.low for p in line.points]
    high = [p.y.high for p in line.points]
    if min(p.y.count for p in line.points) >= MIN_SCENES and low != high:
        band = {"color": style["color"], "zorder": style["zorder"] - 1}
        if len(x) > 1:
            axes.fill_between(x, low, high, alpha=0.13, linewidth=0, **band)
        else:
            axes.vlines(x, low, high, alpha=0.35, linewidth=2.5, **band)
    axes.plot(x, y, markersize=3.6, markeredgecolor="white", markeredgewidth=0.5, **style)
