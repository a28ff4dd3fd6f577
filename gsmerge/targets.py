"""How many Gaussians: what a budget, a preset or a quality target asks for, and the search for the last."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from gsmerge.allocate import PRESETS, count_for_bytes, parse_budget, parse_bytes

LEVEL_FACTOR = 4  # each level of detail has this many times fewer Gaussians than the one before
RUNGS = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0, 2.0)  # of the usual count: where the scene's curve is measured
AUTO_RUNGS = RUNGS[1:5]  # the same where only its knee is looked for
SSIM_DB = 40.0  # dB that count as much as 1 of SSIM: where 1 % of the Gaussians beats 4 % in PSNR it still blurs
KNEE = 0.15  # dB of that mixture per doubling of the count: below it, more Gaussians are not worth it
SLOPE = 1.0  # dB per doubling of the count, until two counts have been tried
CLOSE = 1.15  # counts this near to each other are one
MAX_RUNS = 6
MOST = 4  # times the usual count is the most that a quality target may take


@dataclass(frozen=True)
class TargetOptions:
    """What decides the number of Gaussians, beside the superpixels of each view and K.

    Args:
        budget: Gaussians in the result: a number, or a share of the input as "2%". Met, and never exceeded.
        max_bytes: Largest size of the result as a ``.ply``: bytes, or as "5MB".
        preset: The most that a ``quest3``, a ``mobile`` or a ``desktop`` draws fluidly; scenes that need fewer
            get fewer.
        max_drop: The fewest Gaussians that lose at most this (dB) against the best that the scene's own curve
            reaches.
        target_psnr: The fewest Gaussians with which the input photos are rendered at this PSNR (dB).
        levels: Levels of detail, each with a quarter of the Gaussians of the one before and fitted by itself.

    Raises:
        ValueError: If a setting is out of range, or both quality targets are given.
    """

    budget: int | str | None = None
    max_bytes: int | str | None = None
    preset: str | None = None
    max_drop: float | None = None
    target_psnr: float | None = None
    levels: int = 1

    def __post_init__(self) -> None:
        if self.budget is not None:
            parse_budget(self.budget, sys.maxsize)
        if self.max_bytes is not None:
            parse_bytes(self.max_bytes)
        if self.preset is not None and self.preset not in PRESETS:
            raise ValueError(f"preset: expected one of {', '.join(PRESETS)}, got {self.preset!r}")
        if self.max_drop is not None and not 0 <= self.max_drop < math.inf:
            raise ValueError(f"max drop: expected at least 0 dB, got {self.max_drop}")
        if self.target_psnr is not None and not 0 < self.target_psnr < math.inf:
            raise ValueError(f"target psnr: expected more than 0 dB, got {self.target_psnr}")
        if self.max_drop is not None and self.target_psnr is not None:
            raise ValueError("expected one of max drop and target psnr, got both")
        if not 1 <= self.levels <= 8:
            raise ValueError(f"levels: expected 1 to 8, got {self.levels}")

    @property
    def searches(self) -> bool:
        """Whether a quality decides the count."""
        return self.max_drop is not None or self.target_psnr is not None


def exact_count(options: TargetOptions, num_input: int, sh_degree: int) -> int | None:
    """The number of Gaussians that a budget or a file size asks for, the smaller of the two; None without either."""
    wanted = []
    if options.budget is not None:
        wanted.append(parse_budget(options.budget, num_input))
    if options.max_bytes is not None:
        wanted.append(count_for_bytes(parse_bytes(options.max_bytes), sh_degree))
    return min(*wanted, num_input) if wanted else None


def most_allowed(options: TargetOptions, num_input: int, sh_degree: int) -> int:
    """The most Gaussians that budget, size and preset leave, at most as many as the input has."""
    limits = [num_input, exact_count(options, num_input, sh_degree), PRESETS.get(options.preset or "")]
    return min(limit for limit in limits if limit is not None)


@dataclass(frozen=True)
class CurvePoint:
    """What a number of Gaussians reaches after a short fit, on parts of the photos that it was not fitted to.

    Args:
        count: Gaussians.
        psnr: dB.
        ssim: Structural similarity.
        lpips: LPIPS (VGG), None where its weights are not installed.
    """

    count: int
    psnr: float
    ssim: float
    lpips: float | None = None


def rungs(shares: Sequence[float], usual: int, least: int, most: int) -> list[int]:
    """Rising counts at which a scene's curve is measured: shares of the usual one, all between least and most."""
    return sorted({min(max(round(usual * share), least), most) for share in shares})


def level_counts(finest: int, levels: int, least: int) -> list[int]:
    """Gaussians of the levels of detail after the finest, as long as there are enough for a coarser one."""
    counts = [finest // LEVEL_FACTOR**i for i in range(1, levels)]
    return [count for count in counts if count >= least]


def count_within(points: Sequence[CurvePoint], max_drop: float) -> int:
    """The fewest Gaussians at which the curve lies at most ``max_drop`` dB below its best.

    Between points the curve is a straight line over the logarithm of the count.

    Args:
        points: By rising count, at least one.
        max_drop: dB.

    Raises:
        ValueError: If there is no point.
    """
    if not points:
        raise ValueError("points: expected at least one, got none")
    wanted = max(p.psnr for p in points) - max_drop
    first = next(i for i, p in enumerate(points) if p.psnr >= wanted)
    if first == 0:
        return points[0].count
    below, above = points[first - 1], points[first]
    share = (wanted - below.psnr) / (above.psnr - below.psnr)
    return math.ceil(below.count * (above.count / below.count) ** share)


def curve_knee(points: Sequence[CurvePoint]) -> int:
    """The count beyond which more Gaussians are not worth it, by PSNR and structure together.

    The quality is PSNR + 40 SSIM, in dB. The knee is the last count up to which it grows by 0.15 dB per doubling, on
    a straight line between the slopes that lie midway between the points.

    Args:
        points: By rising count, at least one.

    Raises:
        ValueError: If there is no point.
    """
    if not points:
        raise ValueError("points: expected at least one, got none")
    if len(points) == 1:
        return points[0].count
    scale = [math.log2(p.count) for p in points]
    quality = [p.psnr + SSIM_DB * p.ssim for p in points]
    pairs = list(pairwise(range(len(points))))
    middles = [(scale[a] + scale[b]) / 2 for a, b in pairs]
    slopes = [(quality[b] - quality[a]) / max(scale[b] - scale[a], 1e-9) for a, b in pairs]
    steep = max((i for i, slope in enumerate(slopes) if slope >= KNEE), default=None)
    if steep is None:
        return points[0].count
    if steep == len(slopes) - 1:
        return points[-1].count
    share = (slopes[steep] - KNEE) / (slopes[steep] - slopes[steep + 1])
    return round(2 ** (middles[steep] + share * (middles[steep + 1] - middles[steep])))


@dataclass(frozen=True)
class Search:
    """The outcome of a search for a quality.

    Args:
        count: The count that was chosen.
        psnr: What it reaches, dB.
        met: Whether that is the target.
        tried: Every count that was run and its PSNR, in the order of the runs.
    """

    count: int
    psnr: float
    met: bool
    tried: tuple[tuple[int, float], ...]


def search_count(run: Callable[[int], float], target: float, start: int, least: int, most: int) -> Search:
    """The fewest Gaussians that reach a PSNR, within 15 %, by a few runs; the best of them where none does.

    Args:
        run: Count -> PSNR (dB), taken to rise with the count.
        target: dB.
        start: First count.
        least: Fewest Gaussians that can be run.
        most: Most Gaussians that are allowed.
    """
    tried: dict[int, float] = {}
    count = min(max(start, least), most)
    while count not in tried and len(tried) < MAX_RUNS:
        tried[count] = run(count)
        count = _next_count(tried, target, least, most)
    reached = [c for c, psnr in tried.items() if psnr >= target]
    chosen = min(reached) if reached else max(tried, key=lambda c: tried[c])
    return Search(chosen, tried[chosen], bool(reached), tuple(tried.items()))


def _next_count(tried: dict[int, float], target: float, least: int, most: int) -> int:
    """Where to look next; a count that was tried already ends the search."""
    above = min((c for c, psnr in tried.items() if psnr >= target), default=None)
    below = max((c for c, psnr in tried.items() if psnr < target and (above is None or c < above)), default=None)
    if above is not None and below is not None:
        if above <= below * CLOSE:
            return above
        slope = (tried[above] - tried[below]) / math.log(above / below)
        step = (target - tried[below]) / slope if slope > 0 else math.log(above / below) / 2
        inner = math.log(above / below)
        return round(below * math.exp(min(max(step + 0.1 * inner, 0.15 * inner), 0.85 * inner)))
    edge = below if above is None else above
    assert edge is not None  # one count has been tried
    doublings = (target - tried[edge]) / SLOPE
    if above is None:
        return min(most, round(edge * 2 ** min(max(doublings, 0.5), 3.0)))
    return max(least, round(edge * 2 ** max(min(doublings, -0.5), -3.0)))
