"""Search for the number of Gaussians: the knee of the scene's curve, a quality target, levels of detail.

A curve is measured by short fits, judged by photos or, of few, by patches of photos that they left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np

from gsmerge.budget import LEVEL_FACTOR
from gsmerge.compaction.forecast import USUAL_TRIES, RunForecast
from gsmerge.compaction.left_out import (
    LEAST_SEEN,
    LEAST_VIEWS,
    LeftOut,
    can_leave_out,
    choose_views,
    leave_out,
    mean_seen,
)
from gsmerge.compaction.result import Candidate, covers_all, may_leave_gaps, measure_input, measure_renders
from gsmerge.facts.prepare import Prepared
from gsmerge.facts.row_colors import PHOTOS, RENDERS
from gsmerge.fit.photo_sizes import holdout_psnr, training_weights
from gsmerge.kernels.elementary import exp, log, power
from gsmerge.pipeline import Build
from gsmerge.plan import FIDELITY_LOSS, Plan
from gsmerge.raster.metrics import WINDOW, ssim
from gsmerge.raster.photos import Photos, render_photos, scene_photos
from gsmerge.runtime.record import begin_part, choose, current_record, note, record_part, report_progress, stage
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.stages import CleanOptions
from gsmerge.stages.segment import knee_count
from gsmerge.types import Gaussians

SHORT, LONG = 60, 300  # steps on samples of the photos: enough to find the knee; to tell tenths of a dB on clean scenes
HOLDOUT = 0.1  # share of the photos' patches
TRIED = "curve: what each count brings"  # progress
RUNGS = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0, 2.0)  # of the usual count: where the scene's curve is measured
AUTO_RUNGS = RUNGS[1:5]  # the same where only its knee is looked for
SSIM_DB = 40.0  # dB that count as much as 1 of SSIM: where 1 % of the Gaussians beats 4 % in PSNR it still blurs
KNEE = 0.15  # dB of that mixture per doubling of the count: below it, more Gaussians are not worth it
SLOPE, RENDERS_SLOPE = 1.0, 3.0  # dB per doubling of the count, of photos and of renders, until two were tried
CLOSE = 1.15  # counts this near to each other are one
NEAR_DB = 0.6  # dB above a target for renders at which a count is near enough: with their slope it is CLOSE
PHOTOS_NEAR_DB = (
    0.2  # the same for photos that decide the default: below FIDELITY_LOSS, as all of the input lose nothing
)
MAX_RUNS = 6
# Of photos that are left out: builds, beside the one that is written; dB per doubling until two were tried, the mean
# below the usual count of eleven captures; dB above a target at which a count is near enough, half of that
MAX_TRIED, NEW_SLOPE, NEW_NEAR = 3, 0.3, 0.15
MAX_FACTOR = 4  # times the usual count is the most that a quality target may take where photos judge it
FAR_DB = 6.0  # dB above a target from which on a count says little about the slope there: all of the input lose nothing
MOSTLY = 0.5  # share of the input's Gaussians from which on a scene is compact already


@dataclass(frozen=True)
class CurvePoint:
    """Quality of a short fit with ``count`` Gaussians, measured on held-out patches of the photos."""

    count: int  # Gaussians
    psnr: float  # dB
    ssim: float  # Structural similarity


T = TypeVar("T")


def meet(build: Callable[[int], T], first: T, choose_next: Callable[[list[T]], int | None]) -> list[T]:
    """Build for one count after another, and return all that was built, beginning with ``first``.

    ``choose_next`` chooses a count by what was built so far; None ends the search.
    """
    built = [first]
    while (count := choose_next(built)) is not None:
        built.append(build(count))
    return built


@dataclass(eq=False)
class CountSearch:
    """Search for the number of Gaussians: one count, or several until a quality is met."""

    plan: Plan  # Target and limits
    first: int | None  # The count to begin with; None: as many as `superpixels` and K give
    rendered: bool = False  # Whether renders of the input judge, which more Gaussians always show better
    left_out: LeftOut | None = None  # What judges in place of own views: photos that the builds leave out
    most: int | None = None  # Gaussians from which on photos that are left out gain nothing; None: as the plan allows
    candidates: list[Candidate] = field(default_factory=list)  # Candidates built so far

    def run(self, build: Callable[[int | None], Candidate], forecast: RunForecast | None = None) -> None:
        """Build a candidate for each count that the search chooses, of which as many are expected as is usual."""
        done = 0

        def build_next(count: int | None) -> Candidate:
            nonlocal done
            if forecast is not None:  # renders mostly are as good as asked for at once; photos that are left out, not
                tries = 1 if self.plan.target_psnr is None or self.rendered > done else max(1, USUAL_TRIES - done)
                forecast.expect_builds(count, tries=tries, again=self.left_out is not None)
            done += 1
            return build(count)

        self.candidates = meet(build_next, build_next(self.first), self.choose_next)

    def choose_next(self, candidates: Sequence[Candidate]) -> int | None:
        """Choose the next count by the candidates built so far; None ends the search."""
        target, limits, keeps = self.plan.target_psnr, self.plan.limits, self.plan.keeps_fidelity
        if target is None or len(candidates) >= (MAX_RUNS if self.left_out is None else MAX_TRIED):
            return None
        usual = keeps and not self.plan.auto_count
        least = min(limits.default, limits.max_count) if usual else limits.min_count
        most = limits.max_count if keeps or self.rendered else min(limits.max_count, MAX_FACTOR * limits.default)
        steps = (RENDERS_SLOPE, NEAR_DB) if self.rendered else (SLOPE, PHOTOS_NEAR_DB if keeps else 0.0)
        if self.left_out is not None:
            most, steps = min(most, self.most or most), (NEW_SLOPE, NEW_NEAR)
        tried = psnr_by_count(candidates)
        count = next_count(tried, target, least, most, *steps)
        return None if count in tried else count

    @property
    def tried(self) -> dict[int, float]:
        """PSNR (dB) by count, in the order of the runs."""
        return psnr_by_count(self.candidates)

    @property
    def count(self) -> int | None:
        """Number of Gaussians of the best candidate; of photos left out, the one at which they reach the target."""
        if self.plan.target_psnr is None or self.left_out is None:
            return self.best.count
        return count_reaching(sorted(self.tried.items()), self.plan.target_psnr) if self.met else self.best.count

    @property
    def best(self) -> Candidate:
        """Candidate with the fewest Gaussians that reaches the target, or the one with the highest PSNR."""
        if self.plan.target_psnr is None:
            return self.candidates[0]
        tried, target = self.tried, self.plan.target_psnr
        reached = [count for count, psnr in tried.items() if psnr >= target]
        chosen = min(reached) if reached else max(tried, key=lambda count: tried[count])
        return next(candidate for candidate in self.candidates if candidate.count == chosen)

    @property
    def met(self) -> bool:
        """Whether a candidate reaches the target."""
        return self.plan.target_psnr is not None and max(self.tried.values()) >= self.plan.target_psnr

    def facts(self, result: Candidate) -> dict[str, Any]:
        """Return the search's entries of a report: ``seconds`` of all candidates, ``choices``, ``notes``, ``unmet``.

        ``result`` is what was made of the best candidate.
        """
        names = dict.fromkeys(name for run in self.candidates for name in run.record.seconds)
        seconds = {name: sum(run.record.seconds.get(name, 0.0) for run in self.candidates) for name in names}
        choices: dict[str, Any] = {}
        notes, unmet = self.notes, None
        if self.plan.target_psnr is not None:
            best, tried, met = self.best, tuple(self.tried.items()), self.met
            left_out = 0 if self.left_out is None else len(self.left_out.photos)
            psnr = best.deciding_psnr if self.count == best.count else self.plan.target_psnr  # between two counts
            choices["search"] = {"count": self.count, "psnr": psnr, "met": met, "tried": tried, "left_out": left_out}
            views = "photos left out" if left_out else "the input views"
            reached = f"{views} reach {psnr or 0.0:.2f} dB with {len(result.gaussians):,} Gaussians"
            if left_out and met:
                notes = [*notes, f"quality: {reached}"]
            elif not met and not self.plan.keeps_fidelity:
                unmet = f"quality: {self.plan.target_psnr:g} dB was asked for; {reached}, the best that was tried"
        return {"seconds": seconds, "choices": choices, "notes": notes, "unmet": unmet}

    @property
    def notes(self) -> list[str]:
        """Note that says how many Gaussians were kept by default, where they are more than usual."""
        count, limits = self.best.count or 0, self.plan.limits
        if not self.plan.keeps_fidelity or count <= limits.default:
            return []
        kept = f"kept {len(self.best.gaussians):,} of {limits.num_input:,} Gaussians"
        short = f"be below {self.plan.target_psnr:g} dB from it"
        good = f"are {self.plan.target_psnr:g} dB from the input or better"
        if not self.rendered:
            short = f"show the photos over {FIDELITY_LOSS:g} dB worse"
            good = f"show the photos at most {FIDELITY_LOSS:g} dB worse than the input"
        if not self.met:
            return [f"{kept}: each of the {len(self.tried)} counts tried would {short}"]
        if count > MOSTLY * limits.num_input:
            return [f"the scene is compact already: {kept}, since fewer would {short}"]
        return [f"{kept}, about the fewest that {good}"]


def psnr_by_count(candidates: Sequence[Candidate]) -> dict[int, float]:
    """Return the PSNR (dB) that decides of each candidate by its count, in their order."""
    return {each.count: each.deciding_psnr or 0.0 for each in candidates if each.count is not None}


def add_target(plan: Plan, prepared: Prepared) -> Plan:
    """Return the plan with the PSNR that keeps the input, if photos show how good the input is.

    Of renders of the input the pixels judge that it covers: any result looks like it where both are empty.
    """
    if prepared.reference.name == RENDERS and may_leave_gaps(prepared, plan):
        shown = measure_renders(prepared.scene.gaussians, prepared, plan)
        plan = plan if covers_all(shown) else replace(plan, covered=shown.covered)
    if not plan.keeps_fidelity or plan.target_psnr is not None:
        return plan
    before = measure_input(prepared, plan)
    assert before is not None, "a scene with photos"
    psnr = before.psnr if covers_all(before) else before.covered_psnr
    return replace(plan, before=before, target_psnr=psnr - FIDELITY_LOSS)


def search_count(prepared: Prepared, plan: Plan, build: Build, forecast: RunForecast | None = None) -> CountSearch:
    """Start a search for the number of Gaussians, and forecast its curve, if it measures one."""
    limits, left_out = plan.limits, leave_out_judges(prepared, plan)
    agreement, most = prepared.agreement, limits.max_count
    if left_out is not None and agreement is not None:
        most = max(limits.min_count, min(most, int(agreement.share * limits.num_pixels)))
    if plan.target_psnr is None:
        return CountSearch(plan, choose_count(prepared, plan, build, left_out, most, forecast))
    first = min(max(limits.default, limits.min_count), most)
    return CountSearch(plan, first, prepared.reference.name == RENDERS, left_out, most)


def leave_out_judges(prepared: Prepared, plan: Plan) -> LeftOut | None:
    """Leave out views whose photos judge a quality that is asked for, or a curve; None where own views do.

    Without a fit no photo has been seen; and a count that keeps the input is compared with what its own views show.
    """
    judged = (plan.target_psnr is not None and not plan.keeps_fidelity) or plan.max_drop is not None or plan.auto_count
    if not judged or plan.fit.fit == "none":
        return None
    if can_leave_out(prepared):
        for views in choose_views(prepared.reference.score_views):
            if left_out := leave_out(prepared.scene, views, prepared):
                return left_out
    if prepared.reference.name == PHOTOS and not plan.auto_count:
        why = f"there are fewer than {LEAST_VIEWS} photos, or others see nothing of what these show"
        if not prepared.scene.has_own_pixels:
            why = "views have no Gaussians of their own, which could be left out with the photos"
        note(f"quality: judged by photos that the fit has seen, as {why}: new views look worse")
    return None


@record_part()
def build_left_out(build: Build, left_out: LeftOut, plan: Plan, count: int | None) -> Candidate:
    """Build a candidate of ``count`` Gaussians without some views, by a ``plan`` for the rest, and score it on them.

    It has as many of the Gaussians as the rest has of the views.
    """
    assert count is not None
    begin_part()
    fitted = build(left_out.rest, plan, left_out.reduce(count))
    with stage("score"):
        psnr = mean_seen(left_out.score(fitted.gaussians), left_out.shares)
    return Candidate(count, fitted, fitted.gaussians, fitted.cameras, psnr, current_record(), psnr)


def choose_count(
    prepared: Prepared, plan: Plan, build: Build, left_out: LeftOut | None, most: int, forecast: RunForecast | None
) -> int | None:
    """Choose the number of Gaussians by the budget or the scene's curve; None: ``superpixels`` and K decide.

    ``left_out``: photos that judge the curve; ``most``: Gaussians that are tried.
    """
    limits, drop = plan.limits, plan.max_drop
    if drop is None and not plan.auto_count:
        return limits.count
    if prepared.reference.name == RENDERS:
        return knee_count(prepared.scene, plan.superpixels)
    with stage("curve"):
        counts = rungs(AUTO_RUNGS if drop is None else RUNGS, limits.default, limits.min_count, most)
        steps = SHORT if drop is None else LONG
        if forecast is not None:
            forecast.expect_curve(counts, steps, limits.default)
        points = measure_curve(prepared, plan, build, steps, counts, left_out)
    choose(curve=[asdict(point) for point in points])
    return curve_knee(points) if drop is None else count_within(points, drop)


def measure_curve(
    prepared: Prepared, plan: Plan, build: Build, steps: int, counts: Sequence[int], left_out: LeftOut | None = None
) -> list[CurvePoint]:
    """Measure PSNR and SSIM of fits with each of the ``counts``.

    The fits take ``steps`` whatever the plan says. PSNR and SSIM are measured at full size on the photos of
    ``left_out``, or without on blocks that the fits leave out.
    """
    short = replace(
        plan.fit, fit="full", fit_steps=steps, half_res_share=1.0, holdout=HOLDOUT, photo_scale=1.0, time_budget=None,
        scored=True, move_cameras=False, share=None,
    )  # fmt: skip
    if left_out is None:
        photos = scene_photos(prepared.scene)[prepared.reference.score_views]
        weights, min_gain = training_weights(photos, HOLDOUT, plan.seed), short.tuning.min_gain
    else:
        seen = np.flatnonzero(left_out.shares > LEAST_SEEN).tolist()
        photos, weights = left_out.photos[seen], [1 - mask.astype(np.float32) for mask in left_out.seen[seen]]
        prepared, plan, min_gain = left_out.rest, left_out.plan(plan), math.inf
    quick = replace(plan.with_fit(short), checkpoint=None, clean=CleanOptions())  # nothing grows
    points: list[CurvePoint] = []
    report_progress(TRIED, 0, len(counts))
    for count in counts:
        begin_part()
        with record_part(silent=True):
            gaussians = build(prepared, quick, left_out.reduce(count) if left_out else count).gaussians
        points.append(_point(count, gaussians, photos, weights, min_gain))
        report_progress(TRIED, len(points), len(counts))
    return points


def _point(count: int, gaussians: Gaussians, photos: Photos, weights: list[np.ndarray], min_gain: float) -> CurvePoint:
    images = [np.clip(image, 0, 1) for image in render_photos(gaussians, photos)]
    views = range(len(photos))
    similar = parallel_map(lambda v: _similarity(images[v], photos.images[v], weights[v] == 0), views)
    return CurvePoint(count, holdout_psnr(images, photos, weights, min_gain), float(np.mean(similar)))


def _similarity(image: np.ndarray, photo: np.ndarray, mask: np.ndarray) -> float:
    """Return SSIM over the windows inside the mask, or over the whole picture without any; 0 if it is too small."""
    if min(mask.shape) < WINDOW:
        return 0.0
    border = WINDOW // 2
    return ssim(image, photo, mask if mask[border:-border, border:-border].any() else None)


def rungs(shares: Sequence[float], usual: int, least: int, most: int) -> list[int]:
    """Return rising counts for measuring a curve: ``shares`` of the usual count, within ``least`` and ``most``."""
    return sorted({min(max(round(usual * share), least), most) for share in shares})


def level_counts(finest: int, plan: Plan) -> list[int]:
    """Return the numbers of Gaussians of the coarser levels; none is below the least allowed count."""
    counts = [finest // LEVEL_FACTOR**i for i in range(1, plan.levels)]
    return [count for count in counts if count >= plan.limits.min_count]


def count_within(points: Sequence[CurvePoint], max_drop: float) -> int:
    """Return the fewest Gaussians whose quality, PSNR + 40 SSIM, lies at most ``max_drop`` dB below the curve's best.

    Points come by rising count. Between them the curve is linear in the logarithm of the count.
    """
    if not points:
        raise ValueError("points: expected at least one, got none")
    qualities = [(p.count, p.psnr + SSIM_DB * p.ssim) for p in points]
    return count_reaching(qualities, max(quality for _, quality in qualities) - max_drop)


def count_reaching(points: Sequence[tuple[int, float]], wanted: float) -> int:
    """Return the fewest Gaussians at which a curve of (count, quality) reaches a quality that one of its points has."""
    first = next(i for i, (_, quality) in enumerate(points) if quality >= wanted)
    if first == 0:
        return points[0][0]
    (count, quality), (more, better) = points[first - 1 : first + 1]
    return math.ceil(count * float(power(more / count, (wanted - quality) / (better - quality))))


def curve_knee(points: Sequence[CurvePoint]) -> int:
    """Return the count beyond which more Gaussians add little quality.

    The quality is PSNR + 40 SSIM, in dB. The knee is the last count at which the quality grows by 0.15 dB per doubling.
    Slopes are interpolated linearly between the midpoints of the points, which come by rising count.
    """
    if not points:
        raise ValueError("points: expected at least one, got none")
    scale = [float(log(p.count) / log(2)) for p in points]
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
    return round(float(power(2, middles[steep] + share * (middles[steep + 1] - middles[steep]))))


def next_count(
    tried: Mapping[int, float], target: float, least: int, most: int, slope: float = SLOPE, near: float = 0.0
) -> int:
    """Choose the next count to try in the search for the fewest Gaussians that reach a PSNR, within 15 %.

    ``tried`` has the PSNR (dB) of at least one count, assumed to rise with the count. If the result is in ``tried``,
    the search ends, as it does ``near`` dB above the target. ``slope``: dB per doubling, until two counts are tried.
    """
    above = min((c for c, psnr in tried.items() if psnr >= target), default=None)
    below = max((c for c, psnr in tried.items() if psnr < target and (above is None or c < above)), default=None)
    if above is not None and tried[above] <= target + near:
        return above
    if above is not None and below is not None:
        if above <= below * CLOSE:
            return above
        inner = float(log(above / below))
        rise = (min(tried[above], target + FAR_DB) - tried[below]) / inner
        step = (target - tried[below]) / rise if rise > 0 else inner / 2
        return round(below * float(exp(min(max(step + 0.1 * inner, 0.15 * inner), 0.85 * inner))))
    if above is None and len(tried) > 1:
        first, last = sorted(tried)[-2:]
        measured = (tried[last] - tried[first]) / float(log(last / first) / log(2.0))
        slope = min(max(measured, slope / 3), slope)
    edge = below if above is None else above
    assert edge is not None  # one count has been tried
    doublings = (target - tried[edge]) / slope
    if above is None:
        return min(most, round(edge * float(power(2, min(max(doublings, 0.5 / slope), 3.0)))))
    return max(least, round(edge * float(power(2, max(min(doublings, -0.5 / slope), -3.0)))))
