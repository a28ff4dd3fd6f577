"""Find the number of Gaussians: by the scene's curve, or by building one count after another for a quality."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from gsmerge.counts.clean_up import build_candidate, clean_fitted, record_dropped
from gsmerge.counts.curve import count_reaching, count_within, curve_counts, curve_knee, measure_curve
from gsmerge.counts.file_size import choose_harmonics, meet_bytes
from gsmerge.method.facts.pictures import PHOTOS, RENDERS
from gsmerge.method.facts.prepared import LEAST_VIEWS, Prepared
from gsmerge.method.kernels.elementary import exp, log, power
from gsmerge.method.pipelines.build import build
from gsmerge.method.pipelines.plan import CountPlan, Plan
from gsmerge.method.stages.segment import knee_count
from gsmerge.plan.counts import FIDELITY_LOSS, level_counts
from gsmerge.plan.forecast import STAGE_STEPS, run_parts
from gsmerge.results.candidate import Candidate, make_candidate
from gsmerge.results.left_out import LeftOut, choose_left_out, leave_out, mean_seen
from gsmerge.results.scores import compares_all_pixels, may_leave_gaps, measure_input, measure_renders
from gsmerge.runtime.record import (
    RunPart,
    add_seconds,
    adopt,
    begin_part,
    current_record,
    expect_parts,
    note,
    record_choices,
    record_part,
    stage,
)
from gsmerge.settings.stages import CleanOptions

# The slope is the gain of PSNR (dB) per doubling of the count. Until two counts were built, a search assumes these
# slopes, against photos and against renders of the input. Photos that were left out gained LEFT_OUT_SLOPE below the
# usual count, in the mean of eleven captures
PHOTOS_SLOPE = 1.0
RENDERS_SLOPE = 3.0
LEFT_OUT_SLOPE = 0.3
SAME_COUNT_RATIO = 1.15  # two counts are the same up to this ratio
# A search against renders ends at a count whose PSNR is at most this many dB above the target. With RENDERS_SLOPE, a
# count at which the search ends is at most SAME_COUNT_RATIO times the least count that reaches the target
NEAR_DB = 0.6
# A search against photos that has to keep the quality of the input ends at a PSNR at most this many dB above the
# target. The number is less than FIDELITY_LOSS, because otherwise the search would end with the whole input, which
# loses nothing
PHOTOS_NEAR_DB = 0.2
MAX_BUILDS = 6  # most builds of a search
MAX_LEFT_OUT_BUILDS = 3  # most builds of a search by left-out photos, in addition to the build of the result
# A PSNR that is more than this many dB above the target is lowered to this limit, because a much higher PSNR, such as
# that of the whole input, says little about the slope near the target
FAR_DB = 6.0


def search_count(prepared: Prepared, plan: Plan) -> Candidate:
    """Build results of several counts, and return the one that the plan asks for.

    The count is the one at which a PSNR is reached, or the one that the scene's curve or a size of the file allows.
    Seconds, choices and notes of the search, and of the result, are recorded.
    """
    if plan.count.target_psnr is not None:
        best = _reach_target(prepared, plan)
    else:
        best = build_candidate(prepared, plan, choose_count(prepared, plan))
        add_seconds(best.record.seconds)
    size = plan.count.file_size
    if size is not None and size.packed:
        best = meet_bytes(best, prepared, plan)
    if size is not None and size.count_without_harmonics is not None:
        best = choose_harmonics(best, prepared, plan)
    adopt(best.record)
    return replace(best, record=current_record())


def _reach_target(prepared: Prepared, plan: Plan) -> Candidate:
    """Build one count after another until the target is reached, and return the best result.

    With left-out photos, what is built during the search lacks these photos, so the best count is built again. If the
    quality of the input is kept, only the best result is cleaned up, because what clean-up leaves out would count as
    errors.
    """
    left_out = leave_out_for_scores(prepared, plan)
    is_cleaned_last = plan.count.keeps_fidelity and plan.clean.asked and left_out is None
    tried_plan = plan if left_out is None else left_out.plan(plan)
    if is_cleaned_last:
        tried_plan = replace(plan, clean=CleanOptions())
    candidates = dict[int, Candidate]()

    def measure(count: int) -> float:
        """Build a result with ``count`` Gaussians, and return the PSNR (dB) that decides about it."""
        if left_out is not None:
            begin_part("build")
            with record_part() as record:
                fitted = build(left_out.rest, tried_plan, left_out.reduce(count))
                with stage("score"):
                    psnr = mean_seen(left_out.score(fitted.gaussians), left_out.shares)
            add_seconds(record.seconds)
            return psnr
        candidates[count] = candidate = build_candidate(prepared, tried_plan, count)
        add_seconds(candidate.record.seconds)
        return candidate.deciding_psnr or 0.0

    limits = plan.count.limits
    most = most_useful(prepared, plan, left_out)
    first = min(max(limits.default, limits.min_count), most)
    search = CountSearch(plan.count, first, prepared.reference.name == RENDERS, left_out, most)
    search.run(measure)
    if left_out is not None:
        best = build_candidate(prepared, plan, search.count)
        add_seconds(best.record.seconds)
    else:
        best = candidates[search.best]
    for text in search.notes(len(best.gaussians)):
        note(text)
    if is_cleaned_last:
        with record_part() as record:
            adopt(best.record)
            gaussians, dropped = clean_fitted(best.fitted, prepared, plan)
            record_dropped(dropped, len(gaussians), None, prepared)
            best = make_candidate(replace(best.fitted, gaussians=gaussians), prepared, plan)
        add_seconds(record.seconds)
    best.record.choices["search"] = search.choices
    return replace(best, unmet=search.describe_unmet(len(best.gaussians)))


def build_levels(best: Candidate, prepared: Prepared, plan: Plan) -> list[Candidate]:
    """Build the coarser levels of detail of a result, which keep the cameras that the result has."""
    prepared = prepared.with_cameras(best.fitted.cameras)
    plan = plan.with_fixed_cameras()
    counts = level_counts(len(best.gaussians), plan.count.levels, plan.count.limits.min_count)
    return [build_candidate(prepared, plan, count) for count in counts]


def most_useful(prepared: Prepared, plan: Plan, left_out: LeftOut | None) -> int:
    """Return the largest count of a search, above which left-out photos gain nothing."""
    limits = plan.count.limits
    agreement = prepared.agreement
    if left_out is None or agreement is None:
        return limits.max_count
    return max(limits.min_count, min(limits.max_count, int(agreement.share * limits.num_pixels)))


@dataclass(eq=False)
class CountSearch:
    """Search for the number of Gaussians at which a PSNR is reached, by building one count after another."""

    plan: CountPlan  # Has the target and the limits
    first: int  # The first count to build
    rendered: bool = False  # Results are scored on renders of the input, which more Gaussians always show better
    left_out: LeftOut | None = None  # Photos for scores, which the fits leave out; None: all views score
    most: int | None = None  # Count above which left-out photos gain nothing; None: only the plan has a limit
    psnrs: dict[int, float] = field(default_factory=dict)  # PSNR (dB) by count, in the order of the builds

    @property
    def target(self) -> float:
        """PSNR (dB) to reach."""
        assert self.plan.target_psnr is not None
        return self.plan.target_psnr

    def run(self, measure: Callable[[int], float]) -> None:
        """Measure the PSNR (dB) of each count that the search chooses."""
        plan = self.plan
        limits = self.plan.limits
        least = limits.min_count
        most = limits.max_count
        if plan.keeps_fidelity and not plan.auto_count:
            least = min(limits.default, limits.max_count)
        if not (plan.keeps_fidelity or self.rendered):
            max_factor = 4  # a quality target against photos may take at most this many times the usual count
            most = min(most, max_factor * limits.default)
        if self.left_out is not None and self.most:
            most = min(most, self.most)
        # The slope (dB per doubling of the count) is assumed at first. The search ends at a PSNR that is at most
        # ``near`` dB above the target
        if self.left_out is not None:
            slope = LEFT_OUT_SLOPE
            near = LEFT_OUT_SLOPE / 2
        elif self.rendered:
            slope = RENDERS_SLOPE
            near = NEAR_DB
        else:
            slope = PHOTOS_SLOPE
            near = PHOTOS_NEAR_DB if plan.keeps_fidelity else 0.0
        count = self.first
        most_builds = MAX_BUILDS if self.left_out is None else MAX_LEFT_OUT_BUILDS
        while count not in self.psnrs and len(self.psnrs) < most_builds:
            self.psnrs[count] = measure(count)
            count = next_count(self.psnrs, self.target, least=least, most=most, slope=slope, near=near)

    @property
    def best(self) -> int:
        """The fewest Gaussians that reach the target; if no count does, the count with the highest PSNR."""
        enough = [count for count, psnr in self.psnrs.items() if psnr >= self.target]
        return min(enough) if enough else max(self.psnrs, key=lambda count: self.psnrs[count])

    @property
    def is_met(self) -> bool:
        """Return whether the best count reaches the target."""
        return self.psnrs[self.best] >= self.target

    @property
    def count(self) -> int:
        """The number of Gaussians that the search has chosen, which is usually the best of the counts.

        With left-out photos, it is the number at which the PSNR of these photos reaches the target. This number may lie
        between two counts.
        """
        if self.left_out is None or not self.is_met:
            return self.best
        return count_reaching(sorted(self.psnrs.items()), self.target)

    @property
    def psnr(self) -> float:
        """PSNR (dB) of the chosen number; between two counts, the target is expected."""
        return self.psnrs.get(self.count, self.target)

    @property
    def choices(self) -> dict[str, Any]:
        """What a report says about the search."""
        num_left_out = 0 if self.left_out is None else len(self.left_out.photos)
        return {
            "count": self.count, "psnr": self.psnr, "met": self.is_met, "tried": tuple(self.psnrs.items()),
            "left_out": num_left_out,
        }  # fmt: skip

    def describe_unmet(self, num_gaussians: int) -> str | None:
        """Say that a result of ``num_gaussians`` misses a target that was asked for; None if it does not."""
        if self.is_met or self.plan.keeps_fidelity:
            return None
        reached = self._describe_reached(num_gaussians)
        why = "" if self.left_out is None else "; the result, which has all photos, may show new views better"
        return f"quality: {self.target:g} dB was asked for; {reached}, the best that was tried{why}"

    def _describe_reached(self, num_gaussians: int) -> str:
        """Say which PSNR a result of ``num_gaussians`` reaches."""
        views = "the input views" if self.left_out is None else "photos that the search left out"
        return f"{views} reach {self.psnr:.2f} dB with {num_gaussians:,} Gaussians"

    def notes(self, num_gaussians: int) -> list[str]:
        """Return a note if keeping the quality of the input takes more Gaussians than usual, or what photos gain."""
        count = self.best
        limits = self.plan.limits
        if not self.plan.keeps_fidelity or count <= limits.default:
            is_told = self.left_out is not None and self.is_met
            return [f"quality: {self._describe_reached(num_gaussians)}"] if is_told else []
        kept = f"kept {num_gaussians:,} of {limits.num_input:,} Gaussians"
        miss = f"be below {self.target:g} dB from it"
        reach = f"are {self.target:g} dB from the input or better"
        if not self.rendered:
            miss = f"show the photos over {FIDELITY_LOSS:g} dB worse"
            reach = f"show the photos at most {FIDELITY_LOSS:g} dB worse than the input"
        if not self.is_met:
            return [f"{kept}: each of the {len(self.psnrs)} counts tried would {miss}"]
        compact_share = 0.5  # a scene is compact already if the result needs more than this share of its Gaussians
        if count > compact_share * limits.num_input:
            return [f"the scene is compact already: {kept}, since fewer would {miss}"]
        fewer = 10  # percent
        hint = f"; --budget {fewer}% keeps fewer" if 100 * count > 2 * fewer * limits.num_input else ""
        return [f"{kept}, about the fewest that {reach}{hint}"]


def add_target(plan: Plan, prepared: Prepared) -> Plan:
    """Add to the plan the PSNR that a result has to reach, and the pixels that count if the input leaves gaps.

    If a result has to keep the quality of the input, the target is the PSNR of the input on the photos, minus the
    allowed loss. If renders of the input stand for photos, only the pixels that the input covers count. In gaps, where
    input and result are both black, any result would look perfect.
    """
    if prepared.reference.name == RENDERS and may_leave_gaps(prepared, plan.score):
        input_score = measure_renders(prepared.scene.gaussians, prepared, plan.score)
        plan = (
            plan
            if compares_all_pixels(input_score)
            else replace(plan, score=replace(plan.score, covered=input_score.covered))
        )
    if not plan.count.keeps_fidelity or plan.count.target_psnr is not None:
        return plan
    before = measure_input(prepared, plan.score)
    assert before is not None, "a scene with photos"
    psnr = before.psnr if compares_all_pixels(before) else before.covered_psnr
    count = replace(plan.count, target_psnr=psnr - FIDELITY_LOSS)
    return replace(plan, count=count, score=replace(plan.score, before=before))


def leave_out_for_scores(prepared: Prepared, plan: Plan) -> LeftOut | None:
    """Leave out views, so that their photos can score candidates or a curve; None if no view is left out.

    Views are left out if a quality target or the curve decides the count, because a fit shows new photos worse than the
    photos that it has seen. No view is left out without a fit, or if candidates only have to be as good as the input.
    """
    has_target = plan.count.target_psnr is not None and not plan.count.keeps_fidelity
    if plan.fit.fit == "none" or not (has_target or plan.count.max_drop is not None or plan.count.auto_count):
        return None
    if prepared.can_leave_out:
        for views in choose_left_out(prepared.reference.score_views):
            if left_out := leave_out(prepared.scene, views, prepared):
                return left_out
    if prepared.reference.name == PHOTOS and not plan.count.auto_count:
        reason = f"there are fewer than {LEAST_VIEWS} photos, or no other view sees what they show"
        if not prepared.scene.has_own_pixels:
            reason = "views have no Gaussians of their own, which could be left out with the photos"
        pictures = "photos that the fit has seen" if has_target else "patches of photos that the fits have not seen"
        note(f"quality: measured on {pictures}, because {reason}; new views look worse")
    return None


def choose_count(prepared: Prepared, plan: Plan) -> int | None:
    """Choose the number of Gaussians by the budget or the scene's curve; None if ``superpixels`` and K decide.

    The curve is measured on left-out photos or, without them, on patches of all photos.
    """
    limits = plan.count.limits
    drop = plan.count.max_drop
    left_out = leave_out_for_scores(prepared, plan)
    if drop is None and not plan.count.auto_count:
        return limits.count
    if prepared.reference.name == RENDERS:
        return knee_count(prepared.scene, plan.merge.superpixels, plan.count.limits)
    with stage("curve"):
        counts, steps = curve_counts(drop, limits.default, limits.min_count, most_useful(prepared, plan, left_out))
        curve_part = RunPart("curve", STAGE_STEPS * len(prepared.scene), steps)
        expect_parts([*[curve_part] * len(counts), *run_parts(prepared, plan)])
        points = measure_curve(prepared, plan, steps, counts, left_out)
    record_choices(
        curve=[asdict(point) for point in points], curve_left_out=0 if left_out is None else len(left_out.photos)
    )
    return curve_knee(points) if drop is None else count_within(points, drop)


def next_count(
    psnrs: Mapping[int, float], target: float, least: int, most: int, slope: float = PHOTOS_SLOPE, near: float = 0.0
) -> int:
    """Choose the next count to build in the search for the fewest Gaussians that reach a PSNR, within 15 %.

    If a count that was built already is near enough, this count is returned, and the search ends. The PSNR is assumed
    to rise with the logarithm of the count. The next count is interpolated between the nearest counts on both sides of
    the target, or extrapolated from one side.

    Args:
        psnrs: PSNR (dB) by count, of at least one count.
        target: The PSNR (dB) to reach.
        least: Fewest Gaussians to build.
        most: Most Gaussians to build.
        slope: PSNR (dB) to assume per doubling of the count, until two counts were built.
        near: A count whose PSNR is at most this many dB above the target is near enough.
    """
    above = min((c for c, psnr in psnrs.items() if psnr >= target), default=None)
    below = max((c for c, psnr in psnrs.items() if psnr < target and (above is None or c < above)), default=None)
    if above is not None and psnrs[above] <= target + near:
        return above
    if above is not None and below is not None:
        if above <= below * SAME_COUNT_RATIO:
            return above
        width = float(log(above / below))  # of the interval between the two counts, on a logarithmic scale
        rise = (min(psnrs[above], target + FAR_DB) - psnrs[below]) / width
        step = (target - psnrs[below]) / rise if rise > 0 else width / 2
        # The count is a little larger than interpolated, to reach the target, and far enough from both built counts to
        # say something new
        return round(below * float(exp(min(max(step + 0.1 * width, 0.15 * width), 0.85 * width))))
    if above is None and len(psnrs) > 1:
        first, last = sorted(psnrs)[-2:]
        measured = (psnrs[last] - psnrs[first]) / float(log(last / first) / log(2.0))
        slope = min(max(measured, slope / 3), slope)
    nearest = below if above is None else above
    assert nearest is not None  # one count has been built
    doublings = (target - psnrs[nearest]) / slope
    # a step changes the PSNR by half a dB at least, and the count by three doublings at most
    if above is None:
        return min(most, round(nearest * float(power(2, min(max(doublings, 0.5 / slope), 3.0)))))
    return max(least, round(nearest * float(power(2, max(min(doublings, -0.5 / slope), -3.0)))))
