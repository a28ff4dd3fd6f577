"""How many Gaussians: the knee of the scene's own curve, a quality target, further levels of detail.

A curve is measured by short fits, judged by parts of the photos that they left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise

import numpy as np

from gsmerge.render.metrics import WINDOW, ssim
from gsmerge.render.photos import Photos, render_photos, scene_photos
from gsmerge.report import CompactResult
from gsmerge.runtime.record import choose, current_record, record_part, report_progress, stage
from gsmerge.runtime.threads import parallel_map
from gsmerge.stages.fit import FitOptions, Fitted
from gsmerge.stages.fit.holdout import holdout_psnr, training_weights
from gsmerge.stages.group import knee_count
from gsmerge.stages.prepare import PreparedScene
from gsmerge.types import Cameras, Gaussians

Build = Callable[[PreparedScene, int | None], Fitted]
Score = Callable[[Fitted, PreparedScene], CompactResult]

SHORT, LONG = 60, 300  # steps of half-size photos: enough to find the knee; to tell tenths of a dB on clean scenes
HOLDOUT = 0.1  # share of the photos' blocks
NET, PERCEPTUAL_VIEWS = "alex", 2  # the fast net, and as many views: LPIPS takes longer than the fit
PERCEPTUAL_SIDE = 64  # pixels, at least
LEVEL_FACTOR = 4  # each level of detail has this many times fewer Gaussians than the one before
RUNGS = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0, 2.0)  # of the usual count: where the scene's curve is measured
AUTO_RUNGS = RUNGS[1:5]  # the same where only its knee is looked for
SSIM_DB = 40.0  # dB that count as much as 1 of SSIM: where 1 % of the Gaussians beats 4 % in PSNR it still blurs
KNEE = 0.15  # dB of that mixture per doubling of the count: below it, more Gaussians are not worth it
SLOPE = 1.0  # dB per doubling of the count, until two counts have been tried
CLOSE = 1.15  # counts this near to each other are one
MAX_RUNS = 6
MAX_FACTOR = 4  # times the usual count is the most that a quality target may take


@dataclass(frozen=True)
class CurvePoint:
    """What a number of Gaussians reaches after a short fit, on parts of the photos that it was not fitted to."""

    count: int  # Gaussians
    psnr: float  # dB
    ssim: float  # Structural similarity
    lpips: float | None = None  # LPIPS (AlexNet), None where its weights are not installed


def choose_count(prepared: PreparedScene, build: Build) -> int | None:
    """The number of Gaussians, as the options and the scene's own curve have it; None: as ``superpixels`` and K say."""
    limits, options = prepared.limits, prepared.options
    drop = options.budget.max_drop
    if drop is None and not options.budget.auto:
        return limits.count
    if prepared.given.images is None or prepared.scene.images is None:
        return knee_count(prepared)
    with stage("curve"):
        counts = rungs(AUTO_RUNGS if drop is None else RUNGS, limits.default, limits.min_count, limits.max_count)
        points = measure_curve(prepared, build, SHORT if drop is None else LONG, counts)
    choose(curve=[asdict(point) for point in points])
    return curve_knee(points) if drop is None else count_within(points, drop)


def search_quality(prepared: PreparedScene, build: Build, score: Score) -> tuple[CompactResult, Cameras]:
    """The fewest Gaussians that render the input photos at the PSNR among the options; the best result where none do.

    The seconds and notes of what came before enter the report. The second result are the canonical cameras.
    """
    target, limits = prepared.options.budget.target_psnr, prepared.limits
    assert target is not None
    results: dict[int, CompactResult] = {}
    cameras: dict[int, Cameras] = {}
    before = current_record()

    def run(count: int) -> float:
        with record_part():
            fitted = build(prepared, count)
            results[count], cameras[count] = score(fitted, prepared), fitted.cameras
        return results[count].report.psnr_after or 0.0

    max_count = min(limits.max_count, MAX_FACTOR * limits.default)
    search = search_count(run, target, min(limits.default, max_count), limits.min_count, max_count)
    result, seconds = results[search.count], dict(before.seconds)
    for one in results.values():
        for name, value in one.report.seconds.items():
            seconds[name] = seconds.get(name, 0.0) + value
    unmet = None
    if not search.met:
        unmet = (
            f"quality: {target:g} dB was asked for, the input views reach {search.psnr:.2f} dB"
            f" with {len(result.gaussians)} Gaussians"
        )
    choices = before.choices | result.report.choices | {"search": asdict(search)}
    notes = [*before.notes, *result.report.notes]
    report = replace(result.report, choices=choices, seconds=seconds, notes=notes, unmet=unmet)
    return replace(result, report=report), cameras[search.count]


def measure_curve(prepared: PreparedScene, build: Build, steps: int, counts: Sequence[int]) -> list[CurvePoint]:
    """PSNR, SSIM and, where its weights are installed, LPIPS (AlexNet) of the photos at some counts.

    The fits take ``steps``, whatever the options say. PSNR and SSIM are those of blocks that the fits leave out, at
    full size; LPIPS needs whole pictures.
    """
    options = prepared.options
    short = FitOptions(fit="full", fit_steps=steps, half_res_share=1.0, holdout=HOLDOUT, rates=options.fit.rates)
    limits = replace(prepared.limits, share=1.0)  # so short a fit does not grow
    quick = replace(prepared, options=replace(options, fit=short), limits=limits, checkpoint=None)
    photos = scene_photos(prepared.scene)[prepared.photo_views]
    weights = training_weights(photos, HOLDOUT, options.seed)
    points: list[CurvePoint] = []
    for count in counts:
        report_progress("curve: what each count brings", len(points), len(counts))
        with record_part(silent=True):
            points.append(_point(count, build(quick, count).gaussians, photos, weights, short.min_gain))
    return points


def _point(count: int, gaussians: Gaussians, photos: Photos, weights: list[np.ndarray], min_gain: float) -> CurvePoint:
    images = [np.clip(image, 0, 1) for image in render_photos(gaussians, photos)]
    views = range(len(photos))
    similar = parallel_map(lambda v: _similarity(images[v], photos.images[v], weights[v] == 0), views)
    perceptual = None
    if min(photos.height, photos.width) >= PERCEPTUAL_SIDE:
        from gsmerge.measure.lpips import lpips, lpips_available  # which needs torch

        if lpips_available(NET):
            some = np.linspace(0, len(photos) - 1, min(PERCEPTUAL_VIEWS, len(photos))).round().astype(int)
            perceptual = float(np.mean([lpips(images[v], photos.images[v], NET) for v in some]))
    psnr = holdout_psnr(images, photos, weights, min_gain)
    return CurvePoint(count, psnr, float(np.mean(similar)), perceptual)


def _similarity(image: np.ndarray, photo: np.ndarray, mask: np.ndarray) -> float:
    """SSIM of the held-out windows that lie inside the picture; of the whole where none does, 0 where none can."""
    if min(mask.shape) < WINDOW:
        return 0.0
    border = WINDOW // 2
    return ssim(image, photo, mask if mask[border:-border, border:-border].any() else None)


def rungs(shares: Sequence[float], usual: int, least: int, most: int) -> list[int]:
    """Rising counts at which a scene's curve is measured: shares of the usual one, all between least and most."""
    return sorted({min(max(round(usual * share), least), most) for share in shares})


def level_counts(finest: int, levels: int, least: int) -> list[int]:
    """Gaussians of the levels of detail after the finest, as long as there are enough for a coarser one."""
    counts = [finest // LEVEL_FACTOR**i for i in range(1, levels)]
    return [count for count in counts if count >= least]


def count_within(points: Sequence[CurvePoint], max_drop: float) -> int:
    """The fewest Gaussians at which the curve lies at most ``max_drop`` dB below its best.

    Between points, which come by rising count, the curve is a straight line over the logarithm of the count.
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
    a straight line between the slopes that lie midway between the points, which come by rising count.
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
    """The outcome of a search for a quality."""

    count: int  # The count that was chosen
    psnr: float  # What it reaches, dB
    met: bool  # Whether that is the target
    tried: tuple[tuple[int, float], ...]  # Every count that was run and its PSNR, in the order of the runs


def search_count(run: Callable[[int], float], target: float, start: int, least: int, most: int) -> Search:
    """The fewest Gaussians that reach a PSNR, within 15 %, by a few runs; the best of them where none does.

    ``run``: count -> PSNR (dB), taken to rise with the count.
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
