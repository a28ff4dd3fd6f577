"""Means over scenes with their intervals, Pareto fronts, and comparisons of methods at equal cost."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

LEVEL = 0.95  # confidence of the intervals


@dataclass(frozen=True)
class Interval:
    """A mean and its confidence interval."""

    mean: float  # over the scenes
    low: float  # lower end of the interval; equal to the mean where there is only one scene
    high: float  # upper end
    count: int  # scenes


@dataclass(frozen=True)
class Verdict:
    """A point of a baseline compared with our curve at the same cost."""

    baseline: str  # name of the baseline's line
    cost: float  # mean cost of the point
    quality: float  # mean quality of the point, over the scenes where ours is known at that cost
    ours: float | None  # our quality at the same cost; None where no scene has so cheap a result of ours
    ahead: Interval | None  # our quality less the baseline's, paired by scene; None with ours
    words: str  # ours above, baseline above, undecided or ours has none so cheap


def t_factor(count: int) -> float:
    """Half-width of a t interval in standard errors, for ``count`` samples."""
    return float(stdtrit(count - 1, 0.5 + LEVEL / 2))


def mean_interval(values: Sequence[float]) -> Interval:
    """The mean of at least one value with its two-sided t interval (Student 1908).

    Few scenes make it wide: 12.7 standard errors for two.
    """
    if not len(values):
        raise ValueError("expected at least one value, got none")
    array = np.asarray(values, np.float64)
    mean = float(array.mean())
    if len(array) == 1:
        return Interval(mean, mean, mean, 1)
    half = t_factor(len(array)) * float(array.std(ddof=1)) / math.sqrt(len(array))
    return Interval(mean, mean - half, mean + half, len(array))


def paired_difference(ours: Mapping[str, float], theirs: Mapping[str, float]) -> Interval:
    """Ours minus theirs over the scenes that both have, at least one, so that the difficulty of a scene cancels."""
    return mean_interval([ours[scene] - theirs[scene] for scene in ours if scene in theirs])


def paired_intervals(values: NDArray[np.float64]) -> list[Interval]:
    """Intervals of ``values [scenes, conditions]``, neither of them 0, without the differences between scenes.

    Scenes differ by several dB and conditions by tenths, so plain intervals would hide the conditions. Here every
    scene's own mean is subtracted first (Cousineau 2005), with the correction for it (Morey 2008).
    """
    num_scenes, num_conditions = values.shape
    if num_conditions == 1 or num_scenes == 1:
        return [mean_interval(column) for column in values.T.tolist()]
    centred = values - values.mean(1, keepdims=True) + values.mean()
    factor = math.sqrt(num_conditions / (num_conditions - 1))
    plain = [mean_interval(column) for column in centred.T.tolist()]
    halves = [factor * (one.high - one.mean) for one in plain]
    return [Interval(i.mean, i.mean - half, i.mean + half, i.count) for i, half in zip(plain, halves, strict=True)]


def pareto_front(costs: Sequence[float], qualities: Sequence[float]) -> list[int]:
    """Indices, by ascending cost, of the points that no other dominates; of equal points the first.

    A point dominates one that is as cheap and worse (a lower quality), or dearer and no better.
    """
    best, front = -math.inf, []
    for i in sorted(range(len(costs)), key=lambda i: (costs[i], -qualities[i], i)):
        if qualities[i] > best:
            best = qualities[i]
            front.append(i)
    return front


def quality_at(costs: Sequence[float], qualities: Sequence[float], cost: float) -> float | None:
    """Quality of a method at a cost: its front, linear over the logarithm of the cost; None below its cheapest point.

    Costs are positive, and a higher quality is better. Beyond the most expensive point the quality is constant.
    """
    front = pareto_front(costs, qualities)
    if not front or cost < costs[front[0]]:
        return None
    at = np.log([costs[i] for i in front])
    return float(np.interp(math.log(cost), at, [qualities[i] for i in front]))


def judge(
    baseline: str,
    points: Mapping[str, tuple[float, float]],
    ours: Mapping[str, Sequence[tuple[float, float]]],
    *,
    higher: bool = True,
) -> Verdict:
    """Whether a baseline's point lies above our curve at equal cost, scene by scene.

    ``points`` has the (cost, quality) of the baseline's point by scene, at least one, ``ours`` all those of ours. A
    side is named only where zero lies outside the interval of the difference, or the baseline has only one scene.
    """
    sign = 1.0 if higher else -1.0
    our_quality: dict[str, float] = {}
    for scene, (cost, _) in points.items():
        curve = ours.get(scene, ())
        value = quality_at([c for c, _ in curve], [sign * q for _, q in curve], cost)
        if value is not None:
            our_quality[scene] = value
    mean_cost = float(np.exp(np.mean([math.log(cost) for cost, _ in points.values()])))
    if not our_quality:
        quality = float(np.mean([q for _, q in points.values()]))
        return Verdict(baseline, mean_cost, quality, None, None, "ours has none so cheap")
    theirs = {scene: sign * points[scene][1] for scene in our_quality}
    ahead = paired_difference(our_quality, theirs)
    words = "ours above" if ahead.low > 0 else "baseline above" if ahead.high < 0 else "undecided"
    if len(our_quality) == 1 < len(points):  # one scene of several is no evidence for the others
        words = "undecided"
    mean_ours = sign * float(np.mean(list(our_quality.values())))
    return Verdict(baseline, mean_cost, sign * float(np.mean(list(theirs.values()))), mean_ours, ahead, words)
