"""Records -> lines over scenes: which runs belong together, what they are called, their means and intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsmerge.research.charts.experiment import OURS, SIZES, WHOLE
from gsmerge.research.charts.record import HIGHER_IS_BETTER, INPUT, RunRecord
from gsmerge.research.charts.statistics import Interval, paired_intervals

FEW_SCENES = 0.4  # share of the scenes that a number of views must have to be shown: not all scenes have as many views
USUAL_RATIO = 0.044  # of the usual result: where one size stands for all
PARTS = ("target_visible", "target", "context_visible", "context")  # what scores are taken over, the best first
PART_WORDS = {
    "target_visible": "held-out views, pixels that the input views see",
    "target": "held-out views",
    "context_visible": "input views, pixels that they see",
    "context": "input views",
}
METRIC_WORDS = {"psnr": "PSNR (dB)", "ssim": "SSIM", "lpips_vgg": "LPIPS (VGG)", "lpips_alex": "LPIPS (AlexNet)"}
LineKey = tuple[str, tuple[tuple[str, Any], ...]]  # method, settings without the size
Value = Callable[[RunRecord], float | None]


@dataclass(frozen=True)
class Point:
    """A setting, over all scenes.

    Args:
        label: The size, or the number of views.
        x: Mean cost over the scenes (geometric).
        y: Mean quality with its interval.
        by_scene: (x, y) of every scene.
    """

    label: str
    x: float
    y: Interval
    by_scene: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Line:
    """A method with its settings, from size to size.

    Args:
        name: For people.
        ours: Whether it is ours, not a rival's.
        points: By rising size or number of views.
    """

    name: str
    ours: bool
    points: tuple[Point, ...]


def line_key(record: RunRecord) -> LineKey:
    """What a record's line is known by."""
    settings = {name: value for name, value in record.settings.items() if name not in SIZES}
    return record.method, tuple(sorted(settings.items()))


def size_label(record: RunRecord) -> str:
    """The size that was asked for; empty for the default one."""
    for name in SIZES:
        if name in record.settings:
            value = record.settings[name]
            number = f"{value:,}" if isinstance(value, int) else str(value)
            return number if name == "budget" else f"{number} superpixels"
    return ""


def line_names(keys: Sequence[LineKey]) -> dict[LineKey, str]:
    """A name for every line: the method, and of its settings those that not all lines of it share."""
    names = {}
    for method, settings in keys:
        others = [dict(other) for name, other in keys if name == method]
        shared = {
            name for name, value in settings if all(other.get(name) == value for other in others) and len(others) > 1
        }
        told = [_word(name, value) for name, value in settings if name not in shared]
        names[method, settings] = ", ".join([method, *told])
    return names


def _word(name: str, value: Any) -> str:
    if name == "fit":
        return {"none": "no fit", "color": "colour fit", "full": "full fit"}.get(value, f"fit {value}")
    return f"K = {value}" if name == "k" else str(value) if name == "segmentation" else f"{name} {value}"


def newest(records: Sequence[RunRecord]) -> tuple[list[RunRecord], list[str]]:
    """One record for each scene, method, settings and number of views, so that no scene counts twice in a mean.

    A folder has several where the files of a scene changed, other scenes of the same name were run by another command,
    or LPIPS or seed were set differently: the last one stays.

    Args:
        records: In the order in which they were made.

    Returns:
        Those that stay, and a note for each name of scenes that others were left out of.
    """
    content = {record.scene: record.scene_sha256 for record in records}
    foreign: dict[str, int] = {}
    found: dict[tuple[str, LineKey, str, int | None], RunRecord] = {}
    for record in records:
        if record.scene_sha256 != content[record.scene]:
            foreign[record.scene] = foreign.get(record.scene, 0) + 1
            continue
        found[record.scene, line_key(record), size_label(record), record.views_asked] = record
    notes = [
        f"{name}: {count} run(s) left out, which read other files or held-out views than the last one of that name"
        for name, count in foreign.items()
    ]
    return list(found.values()), notes


def usable(records: Sequence[RunRecord]) -> list[RunRecord]:
    """Those that did not fail."""
    return [record for record in records if record.error is None]


def best_part(records: Sequence[RunRecord]) -> str:
    """What scores are taken over: the best that nine of ten runs know."""
    known = {part: sum(record.score(f"psnr_{part}") is not None for record in records) for part in PARTS}
    return next((part for part in PARTS if records and known[part] >= 0.9 * len(records)), PARTS[-1])


def metrics_of(records: Sequence[RunRecord], part: str) -> list[str]:
    """PSNR, SSIM and one LPIPS, VGG before AlexNet, of those that were measured."""
    known = [m for m in HIGHER_IS_BETTER if any(record.score(f"{m}_{part}") is not None for record in records)]
    return [m for m in known if m != "lpips_alex" or "lpips_vgg" not in known]


def score_of(metric: str, part: str) -> Value:
    """A score as a function of the record."""
    return lambda record: record.score(f"{metric}_{part}")


def usual_views(records: Sequence[RunRecord]) -> int | None:
    """The number of views asked for that stands for all: all of them, or the most."""
    asked = {record.views_asked for record in records}
    return None if None in asked else max((views for views in asked if views is not None), default=None)


def usual_size(records: Sequence[RunRecord]) -> str:
    """The size that stands for all: whose results are nearest the usual share of the input."""
    ratios: dict[str, list[float]] = {}
    for record in records:
        if record.method == OURS and record.ratio:
            ratios.setdefault(size_label(record), []).append(math.log(record.ratio / USUAL_RATIO))
    return min(ratios, key=lambda size: (abs(float(np.mean(ratios[size]))), size), default="")


def stands_for_all(record: RunRecord, size: str) -> bool:
    """Whether a run has the size that stands for all, or a method that has one size alone."""
    return record.method != INPUT and (size_label(record) == size or record.method in WHOLE)


def by_size(records: Sequence[RunRecord], x: Value, y: Value) -> list[Line]:
    """Lines from size to size, at the usual number of views."""
    views = usual_views(records)
    merged = [r for r in records if r.method != INPUT and r.views_asked == views]
    return _lines(merged, size_label, lambda record: record.ratio or 0.0, x, y)


def by_views(records: Sequence[RunRecord], y: Value, *, with_input: bool = False) -> list[Line]:
    """Lines from number of views to number of views, at the usual size; empty where there is one number alone."""
    size = usual_size(records)
    chosen = [r for r in records if (r.method == INPUT and with_input) or stands_for_all(r, size)]
    lines = _lines(chosen, lambda r: str(r.views), lambda r: r.views or 0, lambda r: r.views, y, least=FEW_SCENES)
    return [line for line in lines if len(line.points) > 1]


def _lines(
    records: Sequence[RunRecord],
    label: Callable[[RunRecord], str],
    order: Callable[[RunRecord], float],
    x: Value,
    y: Value,
    least: float = 0.5,
) -> list[Line]:
    """Lines of points that have at least a share of the scenes, all over the same ones."""
    cells: dict[LineKey, dict[str, dict[str, tuple[float, float]]]] = {}
    for record in sorted(records, key=order):
        at, value = x(record), y(record)
        if at is not None and value is not None:
            cells.setdefault(line_key(record), {}).setdefault(label(record), {})[record.scene] = (float(at), value)
    _keep_common(cells, least)
    columns = [points for line in cells.values() for points in line.values()]
    intervals = dict(zip(map(id, columns), _intervals(columns), strict=True))
    names = line_names(list(cells))
    lines = []
    for key, sizes in sorted(cells.items(), key=lambda cell: (cell[0][0] != OURS, len(cell[0][1]))):
        points = [Point(name, _middle(found), intervals[id(found)], found) for name, found in sizes.items()]
        lines.append(Line(names[key], key[0] == OURS, tuple(points)))
    return lines


def _keep_common(cells: dict[LineKey, dict[str, dict[str, tuple[float, float]]]], least: float) -> None:
    """Leave only scenes that every point has, so that all means are over the same; all, where that leaves none.

    Points that have too few of the scenes are left out first: a few failed runs must not cost the rest.
    """
    num_scenes = len({scene for line in cells.values() for points in line.values() for scene in points})
    for key in list(cells):
        cells[key] = {name: points for name, points in cells[key].items() if len(points) >= least * num_scenes}
        if not cells[key]:
            del cells[key]
    columns = [points for line in cells.values() for points in line.values()]
    common = set.intersection(*map(set, columns)) if columns else set()
    if common:
        for points in columns:
            for scene in points.keys() - common:
                del points[scene]


def _middle(points: Mapping[str, tuple[float, float]]) -> float:
    """Geometric mean of the costs; arithmetic where one is not positive."""
    costs = [x for x, _ in points.values()]
    if min(costs) == max(costs):
        return costs[0]
    return float(np.exp(np.mean(np.log(costs)))) if min(costs) > 0 else float(np.mean(costs))


def _intervals(columns: Sequence[Mapping[str, tuple[float, float]]]) -> list[Interval]:
    """One for each column, without what scenes differ by; of no width where the columns have different ones."""
    if columns and all(column.keys() == columns[0].keys() for column in columns):
        values = [[column[scene][1] for column in columns] for scene in sorted(columns[0])]
        return paired_intervals(np.array(values, np.float64))
    means = [float(np.mean([y for _, y in column.values()])) for column in columns]
    return [Interval(mean, mean, mean, len(column)) for mean, column in zip(means, columns, strict=True)]


def scene_points(records: Sequence[RunRecord], x: Value, y: Value) -> dict[str, list[tuple[float, float]]]:
    """All (x, y) of our runs at the usual number of views, by scene."""
    views, found = usual_views(records), dict[str, list[tuple[float, float]]]()
    for record in records:
        at, value = x(record), y(record)
        if record.method == OURS and record.views_asked == views and at is not None and value is not None:
            found.setdefault(record.scene, []).append((at, value))
    return found


def input_mean(records: Sequence[RunRecord], value: Value, scenes: Sequence[str]) -> float | None:
    """Mean of the unmerged input over some scenes, at the usual number of views."""
    views = usual_views(records)
    found = {r.scene: value(r) for r in records if r.method == INPUT and r.views_asked == views}
    values = [v for scene in scenes if (v := found.get(scene)) is not None]
    return float(np.mean(values)) if values and len(values) == len(scenes) else None
