"""What each figure shows, as plain numbers: everything that is decided before drawing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmerge.measure.comparison import break_even
from gsmerge.research.charts import series
from gsmerge.research.charts.experiment import OURS
from gsmerge.research.charts.proxies import SEGMENTATIONS, Proxy
from gsmerge.research.charts.record import HIGHER_IS_BETTER, INPUT, RunRecord
from gsmerge.research.charts.run import SCORING
from gsmerge.research.charts.series import Getter, Line, Point
from gsmerge.research.charts.statistics import Verdict, judge, paired_intervals
from gsmerge.runtime.record import STAGES

RATIOS = (0.0045, 0.22)  # of the points of baselines that are compared: 0.5 % to 20 %, with room for rounding
SAME_COUNT = 0.01  # counts that differ by less than this share are drawn once
MIN_GAIN = 0.05  # share of the render time; smaller gains are noise
MIN_STAGE = 0.03  # share of the longest bar; shorter stages are shown together
INTERVAL_NOTE = (
    "Means over {scenes}; bands, from three scenes on: 95 % t intervals of the differences between"
    " settings, without those between scenes."
)

DIGITS = {"psnr": 2, "ssim": 3, "lpips_vgg": 3, "lpips_alex": 3}  # decimals that are shown of a metric


@dataclass(frozen=True)
class Panel:
    """One pair of axes."""

    y_label: str  # with unit
    higher: bool  # whether higher is better
    lines: tuple[Line, ...]  # the lines
    reference: tuple[str, float] | None = None  # a level to compare with: its name and value


@dataclass(frozen=True)
class Curves:
    """Lines over one x."""

    name: str  # of its files
    title: str  # of the section
    caption: str  # of the figure
    x_label: str  # with unit
    panels: tuple[Panel, ...]  # side by side
    x_scale: str = "log"  # log or linear
    y_scale: str = "linear"  # the same
    percent: bool = False  # whether x is a share, shown in per cent
    front: bool = False  # whether the Pareto front is marked
    all_of: str | None = None  # the figure that shows the main lines of this one; None: it is no such figure's


@dataclass(frozen=True)
class Bars:
    """Stacked bars: seconds by stage."""

    name: str  # of its files
    title: str  # of the section
    caption: str  # of the figure
    rows: tuple[str, ...]  # names of the bars, ours first
    stages: dict[str, tuple[float, ...]]  # seconds of each row by stage, in the order of the stages


@dataclass(frozen=True)
class BreakEven:
    """When merging has saved as much render time as it took."""

    name: str  # of its files
    title: str  # of the section
    caption: str  # of the figure
    input_ms: float  # milliseconds per view of the input
    # name, seconds of the merge, milliseconds per view afterwards, frames to break even (None: never)
    rows: tuple[tuple[str, float, float, float | None], ...]
    all_of: str | None = None  # as of curves


Figure = Curves | Bars | BreakEven


def make_figures(records: Sequence[RunRecord], proxies: Sequence[Proxy] = ()) -> list[Figure]:
    """All figures that the records have data for."""
    done = series.successful(records)
    part = series.choose_part(done)
    figures: list[Figure | None] = [_against(done, part, "seconds"), _against(done, part, "ratio"), _stages(done)]
    figures += [_proxy(proxies), _counts(done), _over_views(done, part), _break_even(done)]
    return [one for figure in figures if figure is not None for one in main_and_all(figure)]


def main_and_all(figure: Figure) -> list[Figure]:
    """A figure of quality or of break-even with one line for each method, and the whole one; itself if it has no more.

    The main line of a method has the best mean in the first panel; a single point is one only where there is no line.
    """
    names: dict[str, str] = {}
    if isinstance(figure, Curves) and figure.name.startswith("quality"):
        first = figure.panels[0]
        sign = 1 if first.higher else -1
        for line in sorted(first.lines, key=lambda one: (len(one.points) > 1, sign * _mean_quality(one))):
            names[_method(line.name)] = line.name
        lines = {line.name for panel in figure.panels for line in panel.lines}
    elif isinstance(figure, BreakEven):
        for name, *_ in reversed(figure.rows):  # those with the fewest settings come first
            names[_method(name)] = name
        lines = {name for name, *_ in figure.rows}
    else:
        return [figure]
    kept = set(names.values())
    if lines == kept:
        return [figure]
    caption = f"{figure.caption} One line for each method; the page has all."
    whole = replace(figure, name=f"{figure.name}-all", all_of=figure.name)
    if isinstance(figure, BreakEven):
        return [replace(figure, caption=caption, rows=tuple(row for row in figure.rows if row[0] in kept)), whole]
    panels = [replace(panel, lines=tuple(line for line in panel.lines if line.name in kept)) for panel in figure.panels]
    return [replace(figure, caption=caption, panels=tuple(panel for panel in panels if panel.lines)), whole]


def _method(name: str) -> str:
    """The method of a line, whose name goes on with settings."""
    return name.split(", ")[0]


def _mean_quality(line: Line) -> float:
    return float(np.mean([point.y.mean for point in line.points]))


def _cost(name: str) -> Getter:
    return lambda record: getattr(record, name) or None


def _scenes(lines: Sequence[Line]) -> list[str]:
    return sorted({scene for line in lines for point in line.points for scene in point.by_scene})


def _over(lines: Sequence[Line]) -> str:
    scenes = _scenes(lines)
    if len(scenes) == 1:
        return f"Scene: {scenes[0]}; one scene has no intervals."
    names = ", ".join(scenes[:8]) + (", ..." if len(scenes) > 8 else "")
    return INTERVAL_NOTE.format(scenes=f"{len(scenes)} scenes ({names})")


def _panels(records: Sequence[RunRecord], part: str, lines_of: Callable[[Getter], list[Line]]) -> list[Panel]:
    """One for each metric that was measured, with its level for the input at the typical number of views."""
    panels = []
    for metric in series.list_metrics(records, part):
        value = series.score_getter(metric, part)
        lines = lines_of(value)
        level = series.input_mean(records, value, _scenes(lines))
        reference = None if level is None else ("input", level)
        panels.append(Panel(series.METRIC_LABELS[metric], HIGHER_IS_BETTER[metric], tuple(lines), reference))
    return panels


def _against(records: Sequence[RunRecord], part: str, cost: str) -> Curves | None:
    """Quality against seconds or against the share of Gaussians that is kept."""
    panels = _panels(records, part, lambda value: series.by_size(records, _cost(cost), value))
    panels = [panel for panel in panels if panel.lines]
    if not panels:
        return None
    words = f"Measured on {series.PART_LABELS[part]}. Rings: the Pareto front. {_over(panels[0].lines)}"
    if cost == "seconds":
        caption = f"Quality against the wall time of the merge (reading and writing not counted). {words}"
        return Curves("quality-seconds", "Quality against time", caption, "Seconds", tuple(panels), front=True)
    caption = f"Quality against the share of the input's Gaussians that is kept. {words}"
    return Curves(
        "quality-ratio", "Quality against size", caption, "Gaussians kept (%)", tuple(panels), percent=True, front=True
    )


def _typical_runs(records: Sequence[RunRecord]) -> dict[str, list[RunRecord]]:
    """Runs of the typical size and number of views by the name of their line, ours first, all over the same scenes."""
    size, views = series.typical_size(records), series.typical_views(records)
    chosen = [r for r in records if series.is_typical(r, size) and r.views_asked == views]
    names, rows = series.names_of(records), dict[str, list[RunRecord]]()
    for record in series.ours_first(chosen):
        rows.setdefault(names[series.line_key(record)], []).append(record)
    kept = series.keep_common({name: {record.scene for record in group} for name, group in rows.items()}, 0.5)
    common = {name: [record for record in rows[name] if record.scene in scenes] for name, scenes in kept.items()}
    return common or rows


def _size_words(records: Sequence[RunRecord]) -> str:
    size = series.typical_size(records)
    return f"Size: {size}." if size else "Size: the default superpixels."


def _stages(records: Sequence[RunRecord]) -> Bars | None:
    rows = _typical_runs(records)
    if not rows:
        return None
    order = [stage for stage in STAGES if stage not in SCORING]
    known = {stage for group in rows.values() for record in group for stage in record.stages} - set(SCORING)
    order += sorted(known - set(order))
    table = {
        stage: tuple(float(np.mean([r.stages.get(stage, 0.0) for r in group])) for group in rows.values())
        for stage in order
    }
    longest = max(sum(column) for column in zip(*table.values(), strict=True))
    large = {stage: values for stage, values in table.items() if max(values) > MIN_STAGE * longest}
    rest = [values for stage, values in table.items() if stage not in large]
    others = tuple(float(sum(column)) for column in zip(*rest, strict=True)) if rest else ()
    stages = large | ({"other": others} if others and max(others) > 0 else {})
    scenes = len({r.scene for group in rows.values() for r in group})
    caption = f"Seconds by stage, scoring left out, means over {scenes} scene(s). {_size_words(records)}"
    return Bars("stages", "Where the time goes", caption, tuple(rows), stages)


def _proxy(proxies: Sequence[Proxy]) -> Curves | None:
    """How well superpixels alone approximate the photos (the paper's proxy)."""
    lines = []
    complete = sorted({p.scene for p in proxies})
    for name in SEGMENTATIONS:
        by_share: dict[float, dict[str, tuple[float, float]]] = {}
        for p in proxies:
            if p.segmentation == name:
                by_share.setdefault(p.share, {})[p.scene] = (float(p.superpixels), p.psnr)
        columns = {share: by_share[share] for share in sorted(by_share) if len(by_share[share]) == len(complete)}
        if columns:
            values = np.array([[by_scene[scene][1] for by_scene in columns.values()] for scene in complete])
            points = tuple(
                Point(f"{100 * share:g}%", float(np.mean([x for x, _ in by_scene.values()])), interval, by_scene)
                for (share, by_scene), interval in zip(columns.items(), paired_intervals(values), strict=True)
            )
            lines.append(Line(name, name == SEGMENTATIONS[0], points))
    if not lines:
        return None
    caption = (
        "Every pixel takes the mean colour of its superpixel; PSNR against the photo, the best that a superpixel method"
        f" could reach. {_over(lines)}"
    )
    panels = (Panel("Proxy PSNR (dB)", True, tuple(lines)),)
    return Curves("proxy", "Superpixels alone", caption, "Superpixels per view", panels)


def _counts(records: Sequence[RunRecord]) -> Curves | None:
    own = [record for record in records if record.method in (OURS, INPUT)]
    lines = series.by_views(own, lambda record: record.count, with_input=True)
    lines = [line for i, line in enumerate(lines) if not any(_coincide(line, other) for other in lines[:i])]
    if not any(line.ours for line in lines):
        return None
    caption = f"Gaussians against the number of input views. {_size_words(records)} {_over(lines)}"
    panels = (Panel("Gaussians", False, tuple(lines)),)
    return Curves("count-views", "Count against views", caption, "Input views", panels, "linear", "log")


def _coincide(one: Line, other: Line) -> bool:
    """Whether two lines coincide, since every method meets a budget."""
    pairs = list(zip(one.points, other.points, strict=False))
    same = all(a.x == b.x and abs(a.y.mean - b.y.mean) <= SAME_COUNT * b.y.mean for a, b in pairs)
    return len(one.points) == len(other.points) and same


def _over_views(records: Sequence[RunRecord], part: str) -> Curves | None:
    panels = _panels(records, part, lambda value: series.by_views(records, value, with_input=True))
    panels = [replace(panel, reference=None) for panel in panels if any(line.ours for line in panel.lines)]
    if not panels:
        return None
    caption = (
        f"Quality against the number of input views, evenly spread; held-out views lie midway between them where their"
        f" order is known. Measured on {series.PART_LABELS[part]}. {_size_words(records)} {_over(panels[0].lines)}"
    )
    return Curves("quality-views", "Quality against views", caption, "Input views", tuple(panels), "linear")


def _break_even(records: Sequence[RunRecord]) -> BreakEven | None:
    rows = _typical_runs(records)
    scenes = sorted({r.scene for group in rows.values() for r in group})
    before = series.input_mean(records, lambda record: record.render_ms, scenes)
    if before is None or not rows:
        return None
    table = []
    for name, group in rows.items():
        seconds = float(np.mean([r.seconds for r in group if r.seconds is not None]))
        after = float(np.mean([r.render_ms for r in group if r.render_ms is not None]))
        even = break_even(seconds, before / 1000, after / 1000) if after < (1 - MIN_GAIN) * before else None
        table.append((name, seconds, after, even))
    caption = (
        "Time to render a number of frames, the merge included, on the processor that ran the grid. Dots: where merging"
        f" breaks even. {_size_words(records)} Means over {len(scenes)} scene(s)."
    )
    return BreakEven("break-even", "When merging pays", caption, before, tuple(table))


@dataclass(frozen=True)
class VerdictTable:
    """Points of baselines compared with ours at equal cost."""

    title: str  # metric and cost
    rows: tuple[tuple[str, Verdict], ...]  # one per point of a baseline, with the label of its size
    decimals: int  # of the metric


def make_verdict_tables(records: Sequence[RunRecord]) -> list[VerdictTable]:
    """Points of baselines compared with ours at equal seconds, and at an equal share of the Gaussians."""
    done = series.successful(records)
    part = series.choose_part(done)
    tables = []
    for cost, words in (("seconds", "at equal time"), ("ratio", "at equal size")):
        for metric in series.list_metrics(done, part):
            value = series.score_getter(metric, part)
            ours = series.scene_points(done, _cost(cost), value)
            rows = [
                (point.label, judge(line.name, point.by_scene, ours, higher=HIGHER_IS_BETTER[metric]))
                for line in series.by_size(done, _cost(cost), value)
                for point in line.points
                if not line.ours and (cost != "ratio" or RATIOS[0] <= point.x <= RATIOS[1])
            ]
            if rows and ours:
                tables.append(VerdictTable(f"{series.METRIC_LABELS[metric]} {words}", tuple(rows), DIGITS[metric]))
    return tables
