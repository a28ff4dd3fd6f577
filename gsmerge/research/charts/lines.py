"""Make lines of figures from records: group runs, and compute means over scenes with intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from gsmerge.frozen import dataclass
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
    """How charts show a score."""

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
    """The results of one method at one size (budget or superpixels), over all scenes."""

    label: str  # size
    x: float  # geometric mean of the cost over the scenes
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

    The interval is wide for few values. With two values the interval reaches 12.7 standard errors to each side.
    """
    if not len(values):
        raise ValueError("expected at least one value, got none")
    array = np.asarray(values, np.float64)
    mean = float(array.mean())
    half = 0.0
    if len(array) > 1:
        factor = float(stdtrit(len(array) - 1, 0.5 + CONFIDENCE / 2))
        half = factor * float(array.std(ddof=1)) / math.sqrt(len(array))
    return Interval(mean, mean - half, mean + half, len(array))


def paired_intervals(values: NDArray[np.float64]) -> list[Interval]:
    """Compute a mean and a confidence interval for each column of ``values [scenes,conditions]``.

    Scenes differ by several dB, but conditions only by tenths of a dB, so usual intervals would hide the effect of
    conditions. Therefore the mean of every scene is subtracted first (Cousineau 2005), and a factor corrects the
    intervals for the subtraction (Morey 2008).
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
    """Name every line by its method, and by the settings in which the lines of the method differ from each other.

    If a method has only one line, its name has all settings.
    """
    names = {}
    for method, settings in keys:
        variants = [dict(other_settings) for other_method, other_settings in keys if other_method == method]
        words = [
            f"{name} {value}"
            for name, value in settings
            if len(variants) == 1 or any(variant.get(name) != value for variant in variants)
        ]
        names[method, settings] = ", ".join([method, *words])
    return names


class Results:
    """The successful runs of a grid, and the choice of scores that tables and figures show.

    Attributes:
        runs: The runs.
        names: Name of each line in figures.
        part: Views and pixels of the scores, a key of ``PARTS``. The first key with scores of nine of ten runs is
            chosen.
        metrics: Names of the scores: PSNR, SSIM, and LPIPS of one network, preferably VGG.
    """

    def __init__(self, records: Iterable[RunRecord]) -> None:
        """Choose names, views, pixels and metrics for the successful runs of ``records``."""
        self.runs = [record for record in records if record.error is None]
        # Runs of gsmerge come first, then baselines. Among the runs of gsmerge, and among the baselines, runs with
        # fewer settings come first
        own_first = sorted(self.runs, key=lambda record: (record.method != OURS, len(line_key(record)[1])))
        keys = dict.fromkeys(map(line_key, own_first))
        self.names = line_names(list(keys))
        counts = {part: sum(run.value(f"psnr_{part}") is not None for run in self.runs) for part in PARTS}
        self.part = next(
            (part for part, count in counts.items() if self.runs and count >= 0.9 * len(self.runs)), "context"
        )
        metrics = [m for m in CHART_METRICS if any(run.value(f"{m}_{self.part}") is not None for run in self.runs)]
        self.metrics = [m for m in metrics if m != "lpips_alex" or "lpips_vgg" not in metrics]

    @property
    def caveat(self) -> str:
        """Warning at the start of captions if no view was held out; empty otherwise."""
        return "" if self.part.startswith("target") else "No view was held out: fits have seen these. "

    def name(self, record: RunRecord) -> str:
        """Return the name of the line that has this run."""
        return self.names[line_key(record)]

    def by_size(self, x: str, y: str) -> list[Line]:
        """Make lines of the score ``y`` against the cost ``x``, one point per size."""
        return make_lines([r for r in self.runs if r.method != INPUT], x, y)

    def input_mean(self, name: str, scenes: Iterable[str]) -> float | None:
        """Average a value of the unmerged input over ``scenes``. Returns None if a scene lacks the value."""
        inputs = {r.scene: r.value(name) for r in self.runs if r.method == INPUT}
        values = [inputs.get(scene) for scene in scenes]
        numbers = [value for value in values if value is not None]
        return float(np.mean(numbers)) if numbers and len(numbers) == len(values) else None


def make_lines(records: Sequence[RunRecord], x: str, y: str) -> list[Line]:
    """Make lines of the score ``y`` against the cost ``x``, which are names of values of a record.

    A point is a mean over scenes. If possible, all points cover the same scenes, see :func:`keep_common`. Runs without
    a positive cost are left out.
    """
    measured: dict[tuple[LineKey, str], dict[str, tuple[float, float]]] = {}  # cost and score by point, then by scene
    for record in sorted(records, key=lambda record: record.percent):
        cost = record.value(x)
        score = record.value(y)
        if cost and score is not None:
            measured.setdefault((line_key(record), size_label(record)), {})[record.scene] = float(cost), score
    common = keep_common({point: set(by_scene) for point, by_scene in measured.items()})
    kept = {point: {s: xy for s, xy in measured[point].items() if s in scenes} for point, scenes in common.items()}
    columns = list(kept.values())
    if columns and all(column.keys() == columns[0].keys() for column in columns):
        values = [[column[scene][1] for column in columns] for scene in sorted(columns[0])]
        intervals = paired_intervals(np.array(values, np.float64))
    else:  # points that differ in their scenes cannot be compared, so their intervals have the width 0
        means = [float(np.mean([y for _, y in column.values()])) for column in columns]
        intervals = [Interval(mean, mean, mean, len(column)) for mean, column in zip(means, columns, strict=True)]
    points: dict[LineKey, list[Point]] = {}
    for ((key, size), by_scene), interval in zip(kept.items(), intervals, strict=True):
        costs = [cost for cost, _ in by_scene.values()]
        # Equal costs are not averaged, since that would round them
        mean_cost = costs[0] if min(costs) == max(costs) else float(np.exp(np.mean(np.log(costs))))
        points.setdefault(key, []).append(Point(size, mean_cost, interval, by_scene))
    names = line_names(list(points))
    keys = sorted(points, key=lambda key: (key[0] != OURS, len(key[1])))
    return [Line(names[key], key[0] == OURS, tuple(points[key])) for key in keys]


def keep_common(scenes_of: Mapping[K, set[str]]) -> dict[K, set[str]]:
    """Choose over which scenes the points of a figure are averaged: if possible, over the same scenes for all points.

    ``scenes_of`` are the measured scenes of each point. First, points with less than ``MIN_SHARE`` of all scenes are
    left out, so that failed runs of one setting do not remove scenes from other points. If the remaining points have no
    scene in common, each point keeps its own scenes.
    """
    fewest = MIN_SHARE * len(set().union(*scenes_of.values()))
    kept = {point: scenes for point, scenes in scenes_of.items() if len(scenes) >= fewest}
    common = set.intersection(*kept.values()) if kept else set()
    return {point: common or scenes for point, scenes in kept.items()}
