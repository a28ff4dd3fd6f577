"""Make lines of figures from records: group runs, and compute means over scenes with intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from gsmerge.research.charts.measure_run import INPUT, RunRecord
from gsmerge.settings.compact import OURS

CONFIDENCE = 0.95  # confidence of the intervals
MIN_SCENES = 3  # least number of scenes of an interval; with two scenes an interval is too wide to be useful
MIN_SHARE = 0.5  # least share of the scenes that every point of a line has
SIZE_SETTINGS = ("budget", "superpixels")  # settings that define the number of Gaussians
PARTS = {  # views and pixels over which scores are averaged; the most meaningful first
    "target_visible": "held-out views, pixels that the input views see",
    "target": "held-out views",
    "context_visible": "input views, pixels that they see",
    "context": "input views",
}
ByScene = Mapping[str, tuple[float, float]]  # x and y of a point for each scene
LineKey = tuple[str, tuple[tuple[str, Any], ...]]  # method, settings without the size
K = TypeVar("K")


@dataclass(frozen=True)
class Metric:
    """Label, direction and decimals of a score."""

    label: str
    higher: bool  # True if higher is better
    digits: int  # number of decimals


CHART_METRICS = {
    "psnr": Metric("PSNR (dB)", True, 2),
    "ssim": Metric("SSIM", True, 3),
    "lpips_vgg": Metric("LPIPS (VGG)", False, 3),
    "lpips_alex": Metric("LPIPS (AlexNet)", False, 3),
}


@dataclass(frozen=True)
class Interval:
    """A mean and its confidence interval."""

    mean: float  # over the scenes
    low: float  # lower end of the interval; equal to the mean if there is only one scene
    high: float  # upper end
    count: int  # number of scenes


@dataclass(frozen=True)
class Point:
    """Values of one method at one size over all scenes."""

    label: str  # size
    x: float  # mean cost over the scenes (geometric)
    y: Interval  # mean quality with its interval
    by_scene: ByScene


@dataclass(frozen=True)
class Line:
    """The points of one method with fixed settings, one point for each size."""

    name: str  # method and settings
    is_own: bool  # True for gsmerge, False for a baseline
    points: tuple[Point, ...]  # by ascending size


def mean_interval(values: Sequence[float]) -> Interval:
    """Compute the mean of at least one value with its two-sided t interval (Student 1908).

    The interval is wide for few values: with two it reaches 12.7 standard errors to each side.
    """
    if not len(values):
        raise ValueError("expected at least one value, got none")
    array = np.asarray(values, np.float64)
    mean, half = float(array.mean()), 0.0
    if len(array) > 1:
        factor = float(stdtrit(len(array) - 1, 0.5 + CONFIDENCE / 2))
        half = factor * float(array.std(ddof=1)) / math.sqrt(len(array))
    return Interval(mean, mean - half, mean + half, len(array))


def paired_intervals(values: NDArray[np.float64]) -> list[Interval]:
    """Compute confidence intervals of the columns of ``values [scenes, conditions]``, without the scenes' differences.

    Scenes differ by several dB, but conditions by tenths. So plain intervals would hide the effect of conditions.
    Here the mean of every scene is subtracted first (Cousineau 2005), and the intervals are corrected for that (Morey
    2008).
    """
    num_scenes, num_conditions = values.shape
    if num_conditions == 1 or num_scenes == 1:
        return [mean_interval(column) for column in values.T.tolist()]
    centred = values - values.mean(1, keepdims=True)
    factor = math.sqrt(num_conditions / (num_conditions - 1))
    halves = [factor * (interval.high - interval.mean) for interval in map(mean_interval, centred.T.tolist())]
    means = values.mean(0).tolist()
    return [Interval(mean, mean - half, mean + half, num_scenes) for mean, half in zip(means, halves, strict=True)]


def line_key(record: RunRecord) -> LineKey:
    """Return the key of a record's line, which is the method and all settings except the size."""
    settings = {name: value for name, value in record.settings.items() if name not in SIZE_SETTINGS}
    return record.method, tuple(sorted(settings.items()))


def size_label(record: RunRecord) -> str:
    """Return the requested size of a run as text; empty for the default."""
    for name in SIZE_SETTINGS:
        if name in record.settings:
            value = record.settings[name]
            number = f"{value:,}" if isinstance(value, int) else str(value)
            return number if name == "budget" else f"{number} superpixels"
    return ""


def line_names(keys: Sequence[LineKey]) -> dict[LineKey, str]:
    """Name every line by its method, and by the settings in which the method's lines differ from each other."""
    names = {}
    for method, settings in keys:
        variants = [dict(other) for name, other in keys if name == method]
        differ = [(n, v) for n, v in settings if len(variants) == 1 or any(other.get(n) != v for other in variants)]
        names[method, settings] = ", ".join([method, *(f"{name} {value}" for name, value in differ)])
    return names


class Results:
    """Successful runs, with values that tables and figures share.

    Attributes:
        runs: The runs.
        names: Name of each line. The line of the input is named by its method.
        part: Key of ``PARTS``, which names views and pixels of the scores. It is the most meaningful part that nine of
            ten runs have.
        metrics: Names of the measured metrics, which are PSNR, SSIM and one LPIPS, VGG if possible.
    """

    def __init__(self, records: Iterable[RunRecord]) -> None:
        self.runs = [record for record in records if record.error is None]
        # gsmerge's own first, then baselines, each by number of settings
        own_first = sorted(self.runs, key=lambda record: (record.method != OURS, len(line_key(record)[1])))
        keys = dict.fromkeys(map(line_key, own_first))
        self.names = line_names(list(keys))
        counts = {part: sum(r.value(f"psnr_{part}") is not None for r in self.runs) for part in PARTS}
        self.part = next((p for p in counts if self.runs and counts[p] >= 0.9 * len(self.runs)), "context")
        names = [m for m in CHART_METRICS if any(r.value(f"{m}_{self.part}") is not None for r in self.runs)]
        self.metrics = [m for m in names if m != "lpips_alex" or "lpips_vgg" not in names]

    @property
    def caveat(self) -> str:
        """Beginning of captions if no view was held out; empty otherwise."""
        return "" if self.part.startswith("target") else "No view was held out: fits have seen these. "

    def name(self, record: RunRecord) -> str:
        """Return the name of a run's line."""
        return self.names[line_key(record)]

    def by_size(self, x: str, y: str) -> list[Line]:
        """Make lines of value ``y`` against value ``x``, one point per size."""
        return make_lines([r for r in self.runs if r.method != INPUT], x, y)

    def input_mean(self, name: str, scenes: Iterable[str]) -> float | None:
        """Average a value of the unmerged input over ``scenes``; None if a scene lacks it."""
        inputs = {r.scene: r.value(name) for r in self.runs if r.method == INPUT}
        values = [inputs.get(scene) for scene in scenes]
        numbers = [value for value in values if value is not None]
        return float(np.mean(numbers)) if numbers and len(numbers) == len(values) else None


def make_lines(records: Sequence[RunRecord], x: str, y: str) -> list[Line]:
    """Make lines from records; all points cover the same scenes, at least ``MIN_SHARE`` of all scenes.

    ``x`` and ``y`` are names of values of a record. Costs x must be positive.
    """
    cells: dict[tuple[LineKey, str], dict[str, tuple[float, float]]] = {}
    for record in sorted(records, key=lambda record: record.percent):
        cost, value = record.value(x), record.value(y)
        if cost and value is not None:
            cells.setdefault((line_key(record), size_label(record)), {})[record.scene] = float(cost), value
    common = keep_common({cell: set(points) for cell, points in cells.items()})
    by_cell = {cell: {s: xy for s, xy in cells[cell].items() if s in scenes} for cell, scenes in common.items()}
    intervals = _cell_intervals(list(by_cell.values()))
    points: dict[LineKey, list[Point]] = {}
    for ((key, size), by_scene), interval in zip(by_cell.items(), intervals, strict=True):
        costs = [cost for cost, _ in by_scene.values()]  # below, equal costs are not averaged, which would round them
        mean_cost = costs[0] if min(costs) == max(costs) else float(np.exp(np.mean(np.log(costs))))
        points.setdefault(key, []).append(Point(size, mean_cost, interval, by_scene))
    names = line_names(list(points))
    keys = sorted(points, key=lambda key: (key[0] != OURS, len(key[1])))
    return [Line(names[key], key[0] == OURS, tuple(points[key])) for key in keys]


def keep_common(scenes: Mapping[K, set[str]]) -> dict[K, set[str]]:
    """Restrict every key to the scenes that all keys share, so that means can be compared.

    Keys with too few scenes are left out first, so that a few failed runs do not remove the other keys. Without common
    scenes each key keeps its own.
    """
    fewest = MIN_SHARE * len(set().union(*scenes.values()))
    covering = {name: scene_names for name, scene_names in scenes.items() if len(scene_names) >= fewest}
    common = set.intersection(*covering.values()) if covering else set()
    return {name: common or scene_names for name, scene_names in covering.items()}


def _cell_intervals(columns: Sequence[ByScene]) -> list[Interval]:
    """Compute an interval of y for each cell, without the scenes' differences.

    If cells differ in their scenes, intervals have the width 0.
    """
    if columns and all(column.keys() == columns[0].keys() for column in columns):
        values = [[column[scene][1] for column in columns] for scene in sorted(columns[0])]
        return paired_intervals(np.array(values, np.float64))
    means = [float(np.mean([y for _, y in column.values()])) for column in columns]
    return [Interval(mean, mean, mean, len(column)) for mean, column in zip(means, columns, strict=True)]
