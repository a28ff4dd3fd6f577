"""Find the number of Gaussians: by the scene's curve, or by building one count after another for a quality."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, TypeVar

from gsmerge.compaction.candidate import Candidate
from gsmerge.compaction.curve import count_reaching, count_within, curve_counts, curve_knee, measure_curve
from gsmerge.compaction.left_out import LEAST_VIEWS, LeftOut, can_leave_out, choose_left_out, leave_out, mean_seen
from gsmerge.compaction.scores import compares_all_pixels, may_leave_gaps, measure_input, measure_renders
from gsmerge.facts.prepare import Prepared
from gsmerge.kernels.elementary import exp, log, power
from gsmerge.photos.row_colors import PHOTOS, RENDERS
from gsmerge.pipeline import Build
from gsmerge.plan import FIDELITY_LOSS, Plan
from gsmerge.runtime.record import begin_part, current_record, note, record_choices, record_part, stage
from gsmerge.stages.segment import knee_count

# The slope is the gain of PSNR (dB) per doubling of the count. Until two counts were built, a search assumes these
# slopes, against photos and against renders of the input
PHOTOS_SLOPE, RENDERS_SLOPE = 1.0, 3.0
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

T = TypeVar("T")


def build_in_turn(build: Callable[[int], T], first: T, choose_next: Callable[[list[T]], int | None]) -> list[T]:
    """Build one candidate after another, and return all of them; ``first`` is built already.

    ``choose_next`` gets all candidates so far, and returns the next count, or None to end.
    """
    built = [first]
    while (count := choose_next(built)) is not None:
        built.append(build(count))
    return built


@dataclass(frozen=True)
class SearchFacts:
    """What a search adds to the report of a run."""

    seconds: dict[str, float]  # Wall time by stage, of all candidates
    choices: dict[str, Any]
    notes: list[str]
    unmet: str | None  # Why the target is not met; None if it is met, or without a target


@dataclass(eq=False)
class CountSearch:
    """Search for the number of Gaussians: the search builds one count, or several until a quality is met."""

    plan: Plan  # Has the target and the limits
    first: int | None  # The first count to build; None: as many as `superpixels` and K give
    rendered: bool = False  # Candidates are scored on renders of the input, which more Gaussians always show better
    left_out: LeftOut | None = None  # Photos for scores, which fits of candidates leave out; None: all views score
    most: int | None = None  # Count above which left-out photos gain nothing; None: only the plan has a limit
    candidates: list[Candidate] = field(default_factory=list)  # Candidates built so far

    def run(self, build: Callable[[int | None], Candidate]) -> None:
        """Build a candidate for each count that the search chooses."""
        self.candidates = build_in_turn(build, build(self.first), self.choose_next)

    def choose_next(self, candidates: Sequence[Candidate]) -> int | None:
        """Choose the next count by the candidates built so far; None ends the search."""
        target = self.plan.target_psnr
        if target is None or len(candidates) >= (MAX_BUILDS if self.left_out is None else MAX_LEFT_OUT_BUILDS):
            return None
        psnrs = psnr_by_count(candidates)
        count = next_count(psnrs, target, *self._allowed_counts(), *self._slope_and_tolerance())
        return None if count in psnrs else count

    def _allowed_counts(self) -> tuple[int, int]:
        """Return the fewest and the most Gaussians that a candidate may have, by the limits and the kind of search."""
        plan, limits = self.plan, self.plan.limits
        least, most = limits.min_count, limits.max_count
        if plan.keeps_fidelity and not plan.auto_count:
            least = min(limits.default, limits.max_count)
        if not (plan.keeps_fidelity or self.rendered):
            max_factor = 4  # a quality target against photos may take at most this many times the usual count
            most = min(most, max_factor * limits.default)
        if self.left_out is not None and self.most:
            most = min(most, self.most)
        return least, most

    def _slope_and_tolerance(self) -> tuple[float, float]:
        """Return the slope to assume at first (dB per doubling of the count), and the tolerance of the search (dB).

        The search ends at a PSNR that is at most the tolerance above the target.
        """
        if self.left_out is not None:
            return 0.3, 0.15  # the mean slope of eleven captures below the usual count; half of it is near enough
        if self.rendered:
            return RENDERS_SLOPE, NEAR_DB
        return PHOTOS_SLOPE, PHOTOS_NEAR_DB if self.plan.keeps_fidelity else 0.0

    @property
    def psnrs(self) -> dict[int, float]:
        """PSNR (dB) of the candidates by count, in the order in which they were built."""
        return psnr_by_count(self.candidates)

    @property
    def count(self) -> int | None:
        """The number of Gaussians that the search has chosen, which is usually the number of the best candidate.

        With left-out photos, it is the number at which the PSNR of these photos reaches the target. This number may lie
        between the counts of two candidates.
        """
        if self.plan.target_psnr is None or self.left_out is None:
            return self.best.count
        return count_reaching(sorted(self.psnrs.items()), self.plan.target_psnr) if self.is_met else self.best.count

    @property
    def best(self) -> Candidate:
        """The candidate with the fewest Gaussians that reaches the target; if none does, the one with the highest PSNR.

        Without a target there is only one candidate.
        """
        if self.plan.target_psnr is None:
            return self.candidates[0]
        psnrs, target = self.psnrs, self.plan.target_psnr
        enough = [count for count, psnr in psnrs.items() if psnr >= target]
        best_count = min(enough) if enough else max(psnrs, key=lambda count: psnrs[count])
        return next(candidate for candidate in self.candidates if candidate.count == best_count)

    @property
    def is_met(self) -> bool:
        """Return whether there is a target and a candidate reaches it."""
        return self.plan.target_psnr is not None and max(self.psnrs.values()) >= self.plan.target_psnr

    def facts(self, result: Candidate) -> SearchFacts:
        """Return what the report says about the search; ``result`` is the final candidate, built after the search."""
        names = dict.fromkeys(name for run in self.candidates for name in run.record.seconds)
        seconds = {name: sum(run.record.seconds.get(name, 0.0) for run in self.candidates) for name in names}
        target = self.plan.target_psnr
        if target is None:
            return SearchFacts(seconds, {}, self.notes, None)
        best, met, left_out = self.best, self.is_met, 0 if self.left_out is None else len(self.left_out.photos)
        # if the count lies between the counts of two candidates, its PSNR is expected to be the target
        psnr = best.deciding_psnr if self.count == best.count else target
        choices: dict[str, Any] = {
            "search": {
                "count": self.count, "psnr": psnr, "met": met, "tried": tuple(self.psnrs.items()), "left_out": left_out,
            }
        }  # fmt: skip
        views = "photos left out" if left_out else "the input views"
        reached = f"{views} reach {psnr or 0.0:.2f} dB with {len(result.gaussians):,} Gaussians"
        notes, unmet = self.notes, None
        if left_out and met:
            notes = [*notes, f"quality: {reached}"]
        elif not met and not self.plan.keeps_fidelity:
            unmet = f"quality: {target:g} dB was asked for; {reached}, the best that was tried"
        return SearchFacts(seconds, choices, notes, unmet)

    @property
    def notes(self) -> list[str]:
        """A note, if keeping the quality of the input takes more Gaussians than usual; otherwise empty."""
        count, limits = self.best.count or 0, self.plan.limits
        if not self.plan.keeps_fidelity or count <= limits.default:
            return []
        kept = f"kept {len(self.best.gaussians):,} of {limits.num_input:,} Gaussians"
        miss = f"be below {self.plan.target_psnr:g} dB from it"
        reach = f"are {self.plan.target_psnr:g} dB from the input or better"
        if not self.rendered:
            miss = f"show the photos over {FIDELITY_LOSS:g} dB worse"
            reach = f"show the photos at most {FIDELITY_LOSS:g} dB worse than the input"
        if not self.is_met:
            return [f"{kept}: each of the {len(self.psnrs)} counts tried would {miss}"]
        compact_share = 0.5  # a scene is compact already if the result needs more than this share of its Gaussians
        if count > compact_share * limits.num_input:
            return [f"the scene is compact already: {kept}, since fewer would {miss}"]
        return [f"{kept}, about the fewest that {reach}"]


def psnr_by_count(candidates: Sequence[Candidate]) -> dict[int, float]:
    """Return the PSNR (dB) that decides about each candidate, by its count, in the order of the candidates."""
    psnrs = dict[int, float]()
    for candidate in candidates:
        if candidate.count is not None:
            psnrs[candidate.count] = candidate.deciding_psnr or 0.0
    return psnrs


def add_target(plan: Plan, prepared: Prepared) -> Plan:
    """Add to the plan the PSNR that a result has to reach, and the pixels that count if the input leaves gaps.

    If a result has to keep the quality of the input, the target is the PSNR of the input on the photos, minus the
    allowed loss. If renders of the input stand for photos, only the pixels that the input covers count. In gaps, where
    input and result are both black, any result would look perfect.
    """
    if prepared.reference.name == RENDERS and may_leave_gaps(prepared, plan):
        input_score = measure_renders(prepared.scene.gaussians, prepared, plan)
        plan = plan if compares_all_pixels(input_score) else replace(plan, covered=input_score.covered)
    if not plan.keeps_fidelity or plan.target_psnr is not None:
        return plan
    before = measure_input(prepared, plan)
    assert before is not None, "a scene with photos"
    psnr = before.psnr if compares_all_pixels(before) else before.covered_psnr
    return replace(plan, before=before, target_psnr=psnr - FIDELITY_LOSS)


def search_count(prepared: Prepared, plan: Plan, build: Build) -> CountSearch:
    """Return the search for the number of Gaussians, before its first build.

    Without a quality target, the search builds one count only. If the scene's curve decides the number, the curve is
    measured here.
    """
    limits, left_out = plan.limits, leave_out_for_scores(prepared, plan)
    agreement, most = prepared.agreement, limits.max_count
    if left_out is not None and agreement is not None:  # left-out photos gain nothing from more Gaussians than this
        most = max(limits.min_count, min(most, int(agreement.share * limits.num_pixels)))
    if plan.target_psnr is None:
        return CountSearch(plan, choose_count(prepared, plan, build, left_out, most))
    first = min(max(limits.default, limits.min_count), most)
    return CountSearch(plan, first, prepared.reference.name == RENDERS, left_out, most)


def leave_out_for_scores(prepared: Prepared, plan: Plan) -> LeftOut | None:
    """Leave out views, so that their photos can score candidates or a curve; None if no view is left out.

    Views are left out if a quality target or the curve decides the count, because a fit shows new photos worse than the
    photos that it has seen. No view is left out without a fit, or if candidates only have to be as good as the input.
    """
    has_target = plan.target_psnr is not None and not plan.keeps_fidelity
    if plan.fit.fit == "none" or not (has_target or plan.max_drop is not None or plan.auto_count):
        return None
    if can_leave_out(prepared):
        for views in choose_left_out(prepared.reference.score_views):
            if left_out := leave_out(prepared.scene, views, prepared):
                return left_out
    if prepared.reference.name == PHOTOS and not plan.auto_count:
        reason = f"there are fewer than {LEAST_VIEWS} photos, or no other view sees what they show"
        if not prepared.scene.has_own_pixels:
            reason = "views have no Gaussians of their own, which could be left out with the photos"
        pictures = "photos that the fit has seen" if has_target else "patches of photos that the fits have not seen"
        note(f"quality: measured on {pictures}, because {reason}; new views look worse")
    return None


@record_part()
def build_left_out(build: Build, left_out: LeftOut, plan: Plan, count: int | None) -> Candidate:
    """Build a candidate from the remaining views, by a ``plan`` for these views, and score it on the left-out photos.

    ``count`` is the number of Gaussians for all views. The candidate has a part of ``count``, in proportion to its
    number of views.
    """
    assert count is not None
    begin_part()
    fitted = build(left_out.rest, plan, left_out.reduce(count))
    with stage("score"):
        psnr = mean_seen(left_out.score(fitted.gaussians), left_out.shares)
    return Candidate(count, fitted, fitted.gaussians, fitted.cameras, psnr, current_record(), psnr)


def choose_count(prepared: Prepared, plan: Plan, build: Build, left_out: LeftOut | None, most: int) -> int | None:
    """Choose the number of Gaussians by the budget or the scene's curve; None if ``superpixels`` and K decide.

    The curve is measured on the photos of ``left_out`` or, without them, on patches of all photos. ``most`` is the
    largest count of the curve.
    """
    limits, drop = plan.limits, plan.max_drop
    if drop is None and not plan.auto_count:
        return limits.count
    if prepared.reference.name == RENDERS:
        return knee_count(prepared.scene, plan.superpixels)
    with stage("curve"):
        counts, steps = curve_counts(drop, limits.default, limits.min_count, most)
        points = measure_curve(prepared, plan, build, steps, counts, left_out)
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
