"""What each figure shows, as plain numbers: everything that is decided before anything is drawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gsmerge.measure.compare import break_even
from gsmerge.research.charts.experiment import OURS
from gsmerge.research.charts.proxies import SEGMENTATIONS, Proxy
from gsmerge.research.charts.record import HIGHER_IS_BETTER, INPUT, RunRecord
from gsmerge.research.charts.run import SCORING
from gsmerge.research.charts.series import (
    METRIC_WORDS,
    PART_WORDS,
    Line,
    Point,
    Value,
    best_part,
    by_size,
    by_views,
    input_mean,
    line_key,
    line_names,
    metrics_of,
    scene_points,
    score_of,
    stands_for_all,
    usable,
    usual_size,
    usual_views,
)
from gsmerge.research.charts.statistics import Verdict, judge, paired_intervals
from gsmerge.runtime.run_log import STAGES

RATIOS = (0.0045, 0.22)  # of rivals' points that are judged: 0.5 % to 20 %, and what rounding does
ALIKE = 0.01  # counts that differ by less than this share are drawn once
NOISE = 0.05  # share of the render time that a gain must exceed to be one
SMALL = 0.03  # share of the longest bar below which a stage is not told apart
BAND_WORDS = (
    "Means over {scenes}; bands, from three scenes on: 95 % t intervals of what the settings differ by, the scenes' own"
    " level taken off."
)


@dataclass(frozen=True)
class Panel:
    """One pair of axes.

    Args:
        y_label: With unit.
        higher: Whether higher is better.
        lines: What is drawn.
        reference: A level to compare with: its name and value.
    """

    y_label: str
    higher: bool
    lines: tuple[Line, ...]
    reference: tuple[str, float] | None = None


@dataclass(frozen=True)
class Curves:
    """Lines over one x.

    Args:
        name: Of its files.
        title: Of the section.
        caption: What it shows, for people.
        x_label: With unit.
        panels: Side by side.
        x_scale: ``log`` or ``linear``.
        y_scale: The same.
        percent: Whether x is a share, told in per cent.
        front: Whether the points that no other beats are marked.
    """

    name: str
    title: str
    caption: str
    x_label: str
    panels: tuple[Panel, ...]
    x_scale: str = "log"
    y_scale: str = "linear"
    percent: bool = False
    front: bool = False


@dataclass(frozen=True)
class Bars:
    """Stacked bars: seconds by stage.

    Args:
        name: Of its files.
        title: Of the section.
        caption: What it shows.
        rows: Names of the bars, ours first.
        stages: Seconds of each row by stage, in the order of the stages.
    """

    name: str
    title: str
    caption: str
    rows: tuple[str, ...]
    stages: dict[str, tuple[float, ...]]


@dataclass(frozen=True)
class Payback:
    """When merging has paid for itself.

    Args:
        name: Of its files.
        title: Of the section.
        caption: What it shows.
        input_ms: Milliseconds per view of the input.
        rows: Name, seconds of the merge, milliseconds per view afterwards, frames until it is even (None: never).
    """

    name: str
    title: str
    caption: str
    input_ms: float
    rows: tuple[tuple[str, float, float, float | None], ...]


Figure = Curves | Bars | Payback


def make_figures(records: Sequence[RunRecord], proxies: Sequence[Proxy] = ()) -> list[Figure]:
    """All figures that the records have data for."""
    good = usable(records)
    part = best_part(good)
    makers: tuple[Callable[[], Figure | None], ...] = (
        lambda: _against(good, part, "seconds"),
        lambda: _against(good, part, "ratio"),
        lambda: _stages(good),
        lambda: _proxy(proxies),
        lambda: _counts(good),
        lambda: _over_views(good, part),
        lambda: _payback(good),
    )
    return [figure for make in makers if (figure := make()) is not None]


def _cost(name: str) -> Value:
    return lambda record: getattr(record, name) or None


def _scenes(lines: Sequence[Line]) -> list[str]:
    return sorted({scene for line in lines for point in line.points for scene in point.by_scene})


def _over(lines: Sequence[Line]) -> str:
    scenes = _scenes(lines)
    if len(scenes) == 1:
        return f"Scene: {scenes[0]}; one scene has no intervals."
    shown = ", ".join(scenes[:8]) + (", ..." if len(scenes) > 8 else "")
    return BAND_WORDS.format(scenes=f"{len(scenes)} scenes ({shown})")


def _against(records: Sequence[RunRecord], part: str, cost: str) -> Curves | None:
    """Quality against seconds or against the share of Gaussians that is kept."""
    panels = []
    for metric in metrics_of(records, part):
        value = score_of(metric, part)
        lines = by_size(records, _cost(cost), value)
        level = input_mean(records, value, _scenes(lines))
        reference = None if level is None else ("input", level)
        panels.append(Panel(METRIC_WORDS[metric], HIGHER_IS_BETTER[metric], tuple(lines), reference))
    panels = [panel for panel in panels if panel.lines]
    if not panels:
        return None
    words = f"Measured on {PART_WORDS[part]}. Rings: points that no other beats. {_over(panels[0].lines)}"
    if cost == "seconds":
        caption = f"Quality against the wall time of the merge (reading and writing not counted). {words}"
        return Curves("quality-seconds", "Quality against time", caption, "Seconds", tuple(panels), front=True)
    caption = f"Quality against the share of the input's Gaussians that is kept. {words}"
    return Curves(
        "quality-ratio", "Quality against size", caption, "Gaussians kept (%)", tuple(panels), percent=True, front=True
    )


def _usual(records: Sequence[RunRecord]) -> dict[str, list[RunRecord]]:
    """Runs of the usual size and number of views by the name of their line, ours first, all over the same scenes."""
    size, views = usual_size(records), usual_views(records)
    chosen = [r for r in records if stands_for_all(r, size) and r.views_asked == views]
    names = line_names(list(dict.fromkeys(line_key(r) for r in records if r.method != INPUT)))
    found: dict[str, list[RunRecord]] = {}
    for record in sorted(chosen, key=lambda r: (r.method != OURS, len(line_key(r)[1]))):
        found.setdefault(names[line_key(record)], []).append(record)
    return _over_common(found)


def _over_common(rows: dict[str, list[RunRecord]]) -> dict[str, list[RunRecord]]:
    """Rows that have at least half of the scenes, over those that all of these have; as they are where none is left."""
    scenes = {name: {record.scene for record in group} for name, group in rows.items()}
    least = 0.5 * len(set().union(*scenes.values()))
    kept = {name: own for name, own in scenes.items() if len(own) >= least}
    common = set.intersection(*kept.values()) if kept else set()
    if not common:
        return rows
    return {name: [record for record in rows[name] if record.scene in common] for name in kept}


def _size_words(records: Sequence[RunRecord]) -> str:
    size = usual_size(records)
    return f"Size: {size}." if size else "Size: the default superpixels."


def _stages(records: Sequence[RunRecord]) -> Bars | None:
    rows = _usual(records)
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
    large = {stage: values for stage, values in table.items() if max(values) > SMALL * longest}
    rest = [values for stage, values in table.items() if stage not in large]
    others = tuple(float(sum(column)) for column in zip(*rest, strict=True)) if rest else ()
    stages = large | ({"other": others} if others and max(others) > 0 else {})
    scenes = len({r.scene for group in rows.values() for r in group})
    caption = f"Seconds by stage, scoring left out, means over {scenes} scene(s). {_size_words(records)}"
    return Bars("stages", "Where the time goes", caption, tuple(rows), stages)


def _proxy(proxies: Sequence[Proxy]) -> Curves | None:
    """How well superpixels alone can show the photos (the paper's proxy)."""
    lines = []
    complete = sorted({p.scene for p in proxies})
    for name in SEGMENTATIONS:
        found: dict[float, dict[str, tuple[float, float]]] = {}
        for p in proxies:
            if p.segmentation == name:
                found.setdefault(p.share, {})[p.scene] = (float(p.superpixels), p.psnr)
        shares = sorted(share for share, by_scene in found.items() if len(by_scene) == len(complete))
        if not shares:
            continue
        values = np.array([[found[share][scene][1] for share in shares] for scene in complete])
        points = tuple(
            Point(f"{100 * share:g}%", float(np.mean([x for x, _ in found[share].values()])), interval, found[share])
            for share, interval in zip(shares, paired_intervals(values), strict=True)
        )
        lines.append(Line(name, name == SEGMENTATIONS[0], points))
    if not lines:
        return None
    caption = (
        "Every pixel takes the mean colour of its superpixel; PSNR against the photo: what a superpixel method could"
        f" reach at best. {_over(lines)}"
    )
    panels = (Panel("Proxy PSNR (dB)", True, tuple(lines)),)
    return Curves("proxy", "Superpixels alone", caption, "Superpixels per view", panels)


def _counts(records: Sequence[RunRecord]) -> Curves | None:
    lines = by_views([r for r in records if r.method in (OURS, INPUT)], lambda record: record.count, with_input=True)
    lines = [line for i, line in enumerate(lines) if not any(_alike(line, other) for other in lines[:i])]
    if not any(line.ours for line in lines):
        return None
    caption = f"Gaussians against the number of input views. {_size_words(records)} {_over(lines)}"
    panels = (Panel("Gaussians", False, tuple(lines)),)
    return Curves("count-views", "Count against views", caption, "Input views", panels, "linear", "log")


def _alike(one: Line, other: Line) -> bool:
    """Whether two lines would lie on each other: a budget is met by every method."""
    pairs = list(zip(one.points, other.points, strict=False))
    same = all(a.x == b.x and abs(a.y.mean - b.y.mean) <= ALIKE * b.y.mean for a, b in pairs)
    return len(one.points) == len(other.points) and same


def _over_views(records: Sequence[RunRecord], part: str) -> Curves | None:
    panels = []
    for metric in metrics_of(records, part):
        lines = by_views(records, score_of(metric, part), with_input=True)
        panels.append(Panel(METRIC_WORDS[metric], HIGHER_IS_BETTER[metric], tuple(lines)))
    panels = [panel for panel in panels if any(line.ours for line in panel.lines)]
    if not panels:
        return None
    caption = (
        f"Quality against the number of input views, evenly spread; held-out views lie midway between them where their"
        f" order is known. Measured on {PART_WORDS[part]}. {_size_words(records)} {_over(panels[0].lines)}"
    )
    return Curves("quality-views", "Quality against views", caption, "Input views", tuple(panels), "linear")


def _payback(records: Sequence[RunRecord]) -> Payback | None:
    rows = _usual(records)
    scenes = sorted({r.scene for group in rows.values() for r in group})
    before = input_mean(records, lambda record: record.render_ms, scenes)
    if before is None or not rows:
        return None
    found = []
    for name, group in rows.items():
        seconds = float(np.mean([r.seconds for r in group if r.seconds is not None]))
        after = float(np.mean([r.render_ms for r in group if r.render_ms is not None]))
        even = break_even(seconds, before / 1000, after / 1000) if after < (1 - NOISE) * before else None
        found.append((name, seconds, after, even))
    caption = (
        "Time to render so many frames, the merge included, on the processor that ran the grid. Dots: frames after"
        f" which merging has paid for itself. {_size_words(records)} Means over {len(scenes)} scene(s)."
    )
    return Payback("break-even", "When merging pays", caption, before, tuple(found))


@dataclass(frozen=True)
class VerdictTable:
    """Rivals' points against ours at equal cost.

    Args:
        title: What is compared.
        rows: One per point of a rival, with the label of its size.
        decimals: Of the qualities.
    """

    title: str
    rows: tuple[tuple[str, Verdict], ...]
    decimals: int


def make_verdicts(records: Sequence[RunRecord]) -> list[VerdictTable]:
    """Whether any rival's point lies above ours at equal cost, for seconds and for the share that is kept."""
    good = usable(records)
    part = best_part(good)
    tables = []
    for cost, words in (("seconds", "at equal time"), ("ratio", "at equal size")):
        for metric in metrics_of(good, part):
            value = score_of(metric, part)
            ours = scene_points(good, _cost(cost), value)
            rows = [
                (point.label, judge(line.name, point.by_scene, ours, higher=HIGHER_IS_BETTER[metric]))
                for line in by_size(good, _cost(cost), value)
                for point in line.points
                if not line.ours and (cost != "ratio" or RATIOS[0] <= point.x <= RATIOS[1])
            ]
            if rows and ours:
                decimals = 2 if metric == "psnr" else 3
                tables.append(VerdictTable(f"{METRIC_WORDS[metric]} {words}", tuple(rows), decimals))
    return tables
