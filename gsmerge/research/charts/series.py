"""Records -> lines over scenes: which runs belong together, their names, means and intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from gsmerge.research.charts.experiment import ONE_SIZE, OURS, SIZES
from gsmerge.research.charts.record import HIGHER_IS_BETTER, INPUT, RunRecord
from gsmerge.research.charts.statistics import Interval, paired_intervals

MIN_SHARE = 0.5  # of the scenes that a point of a line must have
MIN_SHARE_VIEWS = 0.4  # the same over the number of views: not all scenes have as many views
TYPICAL_RATIO = 0.044  # share of the Gaussians: runs nearest it represent all sizes
PART_LABELS = {  # what scores are means over, the most meaningful first
    "target_visible": "held-out views, pixels that the input views see",
    "target": "held-out views",
    "context_visible": "input views, pixels that they see",
    "context": "input views",
}
METRIC_LABELS = {"psnr": "PSNR (dB)", "ssim": "SSIM", "lpips_vgg": "LPIPS (VGG)", "lpips_alex": "LPIPS (AlexNet)"}
LineKey = tuple[str, tuple[tuple[str, Any], ...]]  # method, settings without the size
Getter = Callable[[RunRecord], float | None]
K = TypeVar("K")


@dataclass(frozen=True)
class Point:
    """A method at one size or number of views, over all scenes."""

    label: str  # size or number of views
    x: float  # mean cost over the scenes (geometric)
    y: Interval  # mean quality with its interval
    by_scene: Mapping[str, tuple[float, float]]  # (x, y) of every scene


@dataclass(frozen=True)
class Line:
    """A method with its settings, from size to size."""

    name: str  # of the method and its settings
    ours: bool  # whether it is ours, not a baseline's
    points: tuple[Point, ...]  # by ascending size or number of views


def line_key(record: RunRecord) -> LineKey:
    """The key of a record's line."""
    settings = {name: value for name, value in record.settings.items() if name not in SIZES}
    return record.method, tuple(sorted(settings.items()))


def size_label(record: RunRecord) -> str:
    """The size that was set; empty for the default one."""
    for name in SIZES:
        if name in record.settings:
            value = record.settings[name]
            number = f"{value:,}" if isinstance(value, int) else str(value)
            return number if name == "budget" else f"{number} superpixels"
    return ""


def line_names(keys: Sequence[LineKey]) -> dict[LineKey, str]:
    """A name for every line: the method, and those of its settings that differ between its lines."""
    names = {}
    for method, settings in keys:
        others = [dict(other) for name, other in keys if name == method]
        alone = len(others) == 1
        labels = [_setting_label(n, v) for n, v in settings if alone or any(other.get(n) != v for other in others)]
        names[method, settings] = ", ".join([method, *labels])
    return names


def _setting_label(name: str, value: Any) -> str:
    if name == "fit":
        return {"none": "no fit", "color": "colour fit", "full": "full fit"}.get(value, f"fit {value}")
    return f"K = {value}" if name == "k" else str(value) if name == "segmentation" else f"{name} {value}"


def names_of(records: Sequence[RunRecord]) -> dict[LineKey, str]:
    """The name of the line of every run; that of the input is its method."""
    merged = line_names(list(dict.fromkeys(line_key(r) for r in ours_first(records) if r.method != INPUT)))
    return {line_key(r): INPUT for r in records if r.method == INPUT} | merged


def ours_first(records: Iterable[RunRecord]) -> list[RunRecord]:
    """Runs of ours, then those of baselines, those with the fewest settings first."""
    return sorted(records, key=lambda record: (record.method != OURS, len(line_key(record)[1])))


def newest(records: Sequence[RunRecord]) -> tuple[list[RunRecord], list[str]]:
    """The last record for each scene, method, settings and number of views, so that no scene counts twice in a mean.

    A folder has several where the files of a scene changed, other scenes of the same name were run by another command,
    or LPIPS or seed were set differently. With a note for each name of scenes with records that were left out.
    """
    content = {record.scene: record.scene_sha256 for record in records}
    foreign: dict[str, int] = {}
    last: dict[tuple[str, LineKey, str, int | None], RunRecord] = {}
    for record in records:
        if record.scene_sha256 != content[record.scene]:
            foreign[record.scene] = foreign.get(record.scene, 0) + 1
            continue
        last[record.scene, line_key(record), size_label(record), record.views_asked] = record
    notes = [
        f"{name}: {count} run(s) left out, which read other files or held-out views than the last one of that name"
        for name, count in foreign.items()
    ]
    return list(last.values()), notes


def successful(records: Sequence[RunRecord]) -> list[RunRecord]:
    """The records of runs that did not fail."""
    return [record for record in records if record.error is None]


def choose_part(records: Sequence[RunRecord]) -> str:
    """What scores are means over: the most meaningful that nine of ten runs have."""
    known = {part: sum(record.score(f"psnr_{part}") is not None for record in records) for part in PART_LABELS}
    return next((part for part in known if records and known[part] >= 0.9 * len(records)), "context")


def list_metrics(records: Sequence[RunRecord], part: str) -> list[str]:
    """The metrics that were measured, of PSNR, SSIM and one LPIPS, VGG if possible."""
    known = [m for m in HIGHER_IS_BETTER if any(record.score(f"{m}_{part}") is not None for record in records)]
    return [m for m in known if m != "lpips_alex" or "lpips_vgg" not in known]


def score_getter(metric: str, part: str) -> Getter:
    """A score as a function of the record."""
    return lambda record: record.score(f"{metric}_{part}")


def typical_views(records: Sequence[RunRecord]) -> int | None:
    """The number of views asked for in figures over other quantities: all, or the largest."""
    asked = {record.views_asked for record in records}
    return None if None in asked else max((views for views in asked if views is not None), default=None)


def typical_size(records: Sequence[RunRecord]) -> str:
    """The size in figures over other quantities: whose results are nearest the typical share of the input."""
    ratios: dict[str, list[float]] = {}
    for record in records:
        if record.method == OURS and record.ratio:
            ratios.setdefault(size_label(record), []).append(math.log(record.ratio / TYPICAL_RATIO))
    return min(ratios, key=lambda size: (abs(float(np.mean(ratios[size]))), size), default="")


def is_typical(record: RunRecord, size: str) -> bool:
    """Whether a run has the typical size, or a method that has only one size."""
    return record.method != INPUT and (size_label(record) == size or record.method in ONE_SIZE)


def by_size(records: Sequence[RunRecord], x: Getter, y: Getter) -> list[Line]:
    """Lines over the size, at the typical number of views."""
    views = typical_views(records)
    merged = [r for r in records if r.method != INPUT and r.views_asked == views]
    return _lines(merged, size_label, lambda record: record.ratio or 0.0, x, y)


def by_views(records: Sequence[RunRecord], y: Getter, *, with_input: bool = False) -> list[Line]:
    """Lines over the number of views, at the typical size; empty where there is only one number."""
    size = typical_size(records)
    chosen = [r for r in records if (r.method == INPUT and with_input) or is_typical(r, size)]
    lines = _lines(chosen, lambda r: str(r.views), lambda r: r.views or 0, lambda r: r.views, y, MIN_SHARE_VIEWS)
    return [line for line in lines if len(line.points) > 1]


def _lines(
    records: Sequence[RunRecord],
    label: Callable[[RunRecord], str],
    order: Callable[[RunRecord], float],
    x: Getter,
    y: Getter,
    min_share: float = MIN_SHARE,
) -> list[Line]:
    """Lines of points that have at least a share of the scenes, all over the same scenes."""
    cells: dict[tuple[LineKey, str], dict[str, tuple[float, float]]] = {}
    for record in sorted(records, key=order):
        at, value = x(record), y(record)
        if at is not None and value is not None:
            cells.setdefault((line_key(record), label(record)), {})[record.scene] = float(at), value
    kept = keep_common({cell: set(points) for cell, points in cells.items()}, min_share)
    keys = list(dict.fromkeys(key for key, _ in kept))
    by_cell = {
        cell: {scene: xy for scene, xy in cells[cell].items() if scene in kept[cell]}
        for cell in sorted(kept, key=lambda cell: keys.index(cell[0]))
    }
    intervals = dict(zip(by_cell, _intervals(list(by_cell.values())), strict=True))
    points: dict[LineKey, list[Point]] = {key: [] for key in keys}
    for (key, name), by_scene in by_cell.items():
        points[key].append(Point(name, _mean_cost(by_scene), intervals[key, name], by_scene))
    names = line_names(keys)
    keys.sort(key=lambda key: (key[0] != OURS, len(key[1])))
    return [Line(names[key], key[0] == OURS, tuple(points[key])) for key in keys]


def keep_common(scenes: Mapping[K, set[str]], min_share: float) -> dict[K, set[str]]:
    """The scenes that all have, so that all means are over the same scenes; each its own, if there are none.

    Those that have too few of the scenes are left out first, so that a few failed runs do not remove the others.
    """
    fewest = min_share * len(set().union(*scenes.values()))
    kept = {name: own for name, own in scenes.items() if len(own) >= fewest}
    common = set.intersection(*kept.values()) if kept else set()
    return {name: common or own for name, own in kept.items()}


def _mean_cost(points: Mapping[str, tuple[float, float]]) -> float:
    """Geometric mean of the costs; arithmetic where one is not positive."""
    costs = [x for x, _ in points.values()]
    if min(costs) == max(costs):
        return costs[0]
    return float(np.exp(np.mean(np.log(costs)))) if min(costs) > 0 else float(np.mean(costs))


def _intervals(columns: Sequence[Mapping[str, tuple[float, float]]]) -> list[Interval]:
    """One for each column, without the differences between scenes; of zero width where columns have other scenes."""
    if columns and all(column.keys() == columns[0].keys() for column in columns):
        values = [[column[scene][1] for column in columns] for scene in sorted(columns[0])]
        return paired_intervals(np.array(values, np.float64))
    means = [float(np.mean([y for _, y in column.values()])) for column in columns]
    return [Interval(mean, mean, mean, len(column)) for mean, column in zip(means, columns, strict=True)]


def scene_points(records: Sequence[RunRecord], x: Getter, y: Getter) -> dict[str, list[tuple[float, float]]]:
    """All (x, y) of our runs at the typical number of views, by scene."""
    views, points = typical_views(records), dict[str, list[tuple[float, float]]]()
    for record in records:
        at, value = x(record), y(record)
        if record.method == OURS and record.views_asked == views and at is not None and value is not None:
            points.setdefault(record.scene, []).append((at, value))
    return points


def input_mean(records: Sequence[RunRecord], value: Getter, scenes: Sequence[str]) -> float | None:
    """Mean of the unmerged input over some scenes, at the typical number of views."""
    views = typical_views(records)
    by_scene = {r.scene: value(r) for r in records if r.method == INPUT and r.views_asked == views}
    values = [v for scene in scenes if (v := by_scene.get(scene)) is not None]
    return float(np.mean(values)) if values and len(values) == len(scenes) else None
