"""How figures look: one column of a paper, colours that the colour-blind tell apart (Okabe and Ito 2008)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter, NullLocator

from gsmerge.research.charts.record import INPUT

INK, MUTED, GRID = "#222222", "#6b6b6b", "#e6e6e6"
OURS = ("#0072B2", "#56B4E9", "#003F66", "#7FA8C9", "#2E5C8A", "#9FC5E8")
RIVALS = ("#D55E00", "#009E73", "#CC79A7", "#E69F00", "#7B4173", "#8C6D31")
RIVAL_DASHES: tuple[Any, ...] = ("-", (0, (4, 1.5)), (0, (1, 1.2)))  # another for every round through the colours
INPUT_COLOR = "#555555"
OUR_DASHES: tuple[Any, ...] = ("-", (0, (4, 1.5)), (0, (1, 1.2)), (0, (5, 1, 1, 1)), "-", (0, (4, 1.5)))
OUR_MARKERS, RIVAL_MARKERS = "oosDvP", "^vD<>XP"
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
    "xtick.color": MUTED,
    "xtick.labelcolor": INK,
    "xtick.labelsize": 7,
    "xtick.major.size": 2.5,
    "xtick.major.width": 0.6,
    "ytick.color": MUTED,
    "ytick.labelcolor": INK,
    "ytick.labelsize": 7,
    "ytick.major.size": 2.5,
    "ytick.major.width": 0.6,
}


@dataclass(frozen=True)
class Look:
    """How a line looks."""

    color: str
    dash: Any
    marker: str
    width: float
    order: int


def looks(names: Sequence[tuple[str, bool]]) -> dict[str, Look]:
    """A look for every line by its name and whether it is ours: ours blue and in front, each rival its own."""
    found: dict[str, Look] = {}
    ours = rivals = 0
    for name, is_ours in names:
        if name == INPUT:
            found[name] = Look(INPUT_COLOR, (0, (2, 2)), "s", 1.0, 2)
        elif is_ours:
            i = ours % len(OURS)
            found[name] = Look(OURS[i], OUR_DASHES[i], OUR_MARKERS[i], 1.6 if ours == 0 else 1.2, 6 - min(ours, 2))
            ours += 1
        else:
            i = rivals % len(RIVALS)
            dash = RIVAL_DASHES[rivals // len(RIVALS) % len(RIVAL_DASHES)]
            found[name] = Look(RIVALS[i], dash, RIVAL_MARKERS[rivals % len(RIVAL_MARKERS)], 1.1, 3)
            rivals += 1
    return found


def log_ticks(low: float, high: float) -> list[float]:
    """Round numbers between two positive ones: 1, 2 and 5 of every decade, or 1 alone where that would be many."""
    decades = range(-12, 13)
    fine = [m * 10.0**e for e in decades for m in (1, 2, 5) if low <= m * 10.0**e * 1.0000001 and m * 10.0**e <= high]
    return fine if len(fine) <= 8 else [10.0**e for e in decades if low <= 10.0**e <= high]


def number(value: float, _: Any = None) -> str:
    """A tick's number, with k and M for thousands and millions."""
    for factor, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= factor * 0.9999999:
            return f"{value / factor:g}{letter}"
    return f"{value:g}"


def log_axis(axes: Axes, which: str, low: float, high: float, *, percent: bool = False) -> None:
    """A logarithmic axis from low to high with round ticks."""
    (axes.set_xscale if which == "x" else axes.set_yscale)("log")
    (axes.set_xlim if which == "x" else axes.set_ylim)(low, high)
    axis = axes.xaxis if which == "x" else axes.yaxis
    factor = 100 if percent else 1
    axis.set_major_locator(FixedLocator([t / factor for t in log_ticks(low * factor, high * factor)]))
    axis.set_major_formatter(FuncFormatter(lambda value, _: number(round(value * factor, 9))))
    axis.set_minor_locator(NullLocator())
    axis.set_minor_formatter(NullFormatter())
