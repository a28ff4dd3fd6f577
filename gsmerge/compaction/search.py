"""Search for the number of Gaussians: by the scene's curve, or by building one count after another for a quality."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, TypeVar

from gsmerge.compaction.candidate import Candidate
from gsmerge.compaction.curve import count_reaching, count_within, curve_counts, curve_knee, measure_curve
from gsmerge.compaction.left_out import LEAST_VIEWS, LeftOut, can_leave_out, choose_left_out, leave_out, mean_seen
from gsmerge.compaction.scores import covers_all, may_leave_gaps, measure_input, measure_renders
from gsmerge.facts.counts import LEVEL_FACTOR
from gsmerge.facts.prepare import Prepared
from gsmerge.kernels.elementary import exp, log, power
from gsmerge.photos.row_colors import PHOTOS, RENDERS
from gsmerge.pipeline import Build
from gsmerge.plan import FIDELITY_LOSS, Plan
from gsmerge.runtime.record import begin_part, current_record, note, record_choices, record_part, stage
from gsmerge.stages.segment import knee_count

# dB of PSNR per doubling of the count, assumed until two counts were tried: against photos, and against renders
PHOTOS_SLOPE, RENDERS_SLOPE = 1.0, 3.0
SAME_COUNT_RATIO = 1.15  # two counts are the same up to this ratio
# A count is near enough at this many dB above a target for renders, which is SAME_COUNT_RATIO at their slope
NEAR_DB = 0.6
# The same bound for photos that decide the default count. It is less than FIDELITY_LOSS, because the whole input has no
# loss at all
PHOTOS_NEAR_DB = 0.2
MAX_RUNS = 6  # most builds of a search
MAX_TRIED = 3  # most builds of a search by left-out photos, in addition to the build of the result
# PSNR is cut at this many dB above a target, because larger values, as of the whole input, say little of the slope
FAR_DB = 6.0

T = TypeVar("T")


def meet(build: Callable[[int], T], first: T, choose_next: Callable[[list[T]], int | None]) -> list[T]:
    """Build for one count after another; return everything that was built, beginning with ``first``.

    ``choose_next`` chooses a count by everything that was built so far; None ends the search.
    """
    built = [first]
    while (count := choose_next(built)) is not None:
        built.append(build(count))
    return built


@dataclass(frozen=True)
class SearchFacts:
    """Facts that a search adds to the report of a run."""

    seconds: dict[str, float]  # Wall time by stage, of all candidates
    choices: dict[str, Any]
    notes: list[str]
    unmet: str | None  # Why the target is not met; None if it is, or if there is none


@dataclass(eq=False)
class CountSearch:
    """Search for the number of Gaussians: one count, or several until a quality is met."""

    plan: Plan  # Target and limits
    first: int | None  # The count to begin with; None: as many as `superpixels` and K give
    rendered: bool = False  # Score candidates on renders of the input, which more Gaussians always show better
    left_out: LeftOut | None = None  # Photos that the candidates leave out and are scored on; None: the own views
    most: int | None = None  # Gaussians from which on left-out photos gain nothing; None: as the plan allows
    candidates: list[Candidate] = field(default_factory=list)  # Candidates built so far

    def run(self, build: Callable[[int | None], Candidate]) -> None:
        """Build a candidate for each count that the search chooses."""
        self.candidates = meet(build, build(self.first), self.choose_next)

    def choose_next(self, candidates: Sequence[Candidate]) -> int | None:
        """Choose the next count by the candidates built so far; None ends the search."""
        target = self.plan.target_psnr
        if target is None or len(candidates) >= (MAX_RUNS if self.left_out is None else MAX_TRIED):
            return None
        tried = psnr_by_count(candidates)
        count = next_count(tried, target, *self._allowed_counts(), *self._expected_slope())
        return None if count in tried else count

    def _allowed_counts(self) -> tuple[int, int]:
        """Return the fewest and the most Gaussians that may be tried."""
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

    def _expected_slope(self) -> tuple[float, float]:
        """Return the dB per doubling of the count to assume at first, and the dB above the target that are enough."""
        if self.left_out is not None:
            # dB per doubling of the count, the mean of eleven captures below the usual count; and dB above a target, at
            # which a count is near enough, since that is half of a doubling
            left_out_slope, left_out_near_db = 0.3, 0.15
            return left_out_slope, left_out_near_db
        if self.rendered:
            return RENDERS_SLOPE, NEAR_DB
        return PHOTOS_SLOPE, PHOTOS_NEAR_DB if self.plan.keeps_fidelity else 0.0

    @property
    def tried(self) -> dict[int, float]:
        """PSNR (dB) by count, in the order of the candidates."""
        return psnr_by_count(self.candidates)

    @property
    def count(self) -> int | None:
        """Number of Gaussians of the best candidate; with left-out photos, the one at which they reach the target."""
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
        best_count = min(reached) if reached else max(tried, key=lambda count: tried[count])
        return next(candidate for candidate in self.candidates if candidate.count == best_count)

    @property
    def met(self) -> bool:
        """Whether a candidate reaches the target."""
        return self.plan.target_psnr is not None and max(self.tried.values()) >= self.plan.target_psnr

    def facts(self, result: Candidate) -> SearchFacts:
        """Return the facts for the report; ``result`` is the final candidate, made from the best one."""
        names = dict.fromkeys(name for run in self.candidates for name in run.record.seconds)
        seconds = {name: sum(run.record.seconds.get(name, 0.0) for run in self.candidates) for name in names}
        target = self.plan.target_psnr
        if target is None:
            return SearchFacts(seconds, {}, self.notes, None)
        best, met, left_out = self.best, self.met, 0 if self.left_out is None else len(self.left_out.photos)
        psnr = best.deciding_psnr if self.count == best.count else target  # a count between two candidates meets it
        tried = tuple(self.tried.items())
        choices: dict[str, Any] = {
            "search": {"count": self.count, "psnr": psnr, "met": met, "tried": tried, "left_out": left_out}
        }
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
        """A note on the number of Gaussians, if it is more than usual because the result has to keep the input."""
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
        compact_share = 0.5  # a scene is compact already if the result needs more than this share of its Gaussians
        if count > compact_share * limits.num_input:
            return [f"the scene is compact already: {kept}, since fewer would {short}"]
        return [f"{kept}, about the fewest that {good}"]


def psnr_by_count(candidates: Sequence[Candidate]) -> dict[int, float]:
    """Return the deciding PSNR (dB) of each candidate by its count, in the order of the candidates."""
    psnrs = dict[int, float]()
    for candidate in candidates:
        if candidate.count is not None:
            psnrs[candidate.count] = candidate.deciding_psnr or 0.0
    return psnrs


def add_target(plan: Plan, prepared: Prepared) -> Plan:
    """Return the plan with the PSNR that a result needs to keep the input, measured on the photos.

    If renders of the input stand for photos, the plan gets the pixels that the input covers instead: only these are
    scored, because any result equals the input where both are empty.
    """
    if prepared.reference.name == RENDERS and may_leave_gaps(prepared, plan):
        input_score = measure_renders(prepared.scene.gaussians, prepared, plan)
        plan = plan if covers_all(input_score) else replace(plan, covered=input_score.covered)
    if not plan.keeps_fidelity or plan.target_psnr is not None:
        return plan
    before = measure_input(prepared, plan)
    assert before is not None, "a scene with photos"
    psnr = before.psnr if covers_all(before) else before.covered_psnr
    return replace(plan, before=before, target_psnr=psnr - FIDELITY_LOSS)


def search_count(prepared: Prepared, plan: Plan, build: Build) -> CountSearch:
    """Prepare a search for the number of Gaussians; measure the scene's curve first if the options need it."""
    limits, left_out = plan.limits, leave_out_for_scores(prepared, plan)
    agreement, most = prepared.agreement, limits.max_count
    if left_out is not None and agreement is not None:  # more Gaussians gain nothing on photos that are left out
        most = max(limits.min_count, min(most, int(agreement.share * limits.num_pixels)))
    if plan.target_psnr is None:
        return CountSearch(plan, choose_count(prepared, plan, build, left_out, most))
    first = min(max(limits.default, limits.min_count), most)
    return CountSearch(plan, first, prepared.reference.name == RENDERS, left_out, most)


def leave_out_for_scores(prepared: Prepared, plan: Plan) -> LeftOut | None:
    """Leave out views, so that their photos can score a quality target or a curve; None if no view is left out.

    Without a fit no photo has been seen, so none has to be left out. A count that keeps the input is scored on the
    input's own views.
    """
    has_target = plan.target_psnr is not None and not plan.keeps_fidelity
    if plan.fit.fit == "none" or not (has_target or plan.max_drop is not None or plan.auto_count):
        return None
    if can_leave_out(prepared):
        for views in choose_left_out(prepared.reference.score_views):
            if left_out := leave_out(prepared.scene, views, prepared):
                return left_out
    if prepared.reference.name == PHOTOS and not plan.auto_count:
        why = f"there are fewer than {LEAST_VIEWS} photos, or no other view sees what they show"
        if not prepared.scene.has_own_pixels:
            why = "views have no Gaussians of their own, which could be left out with the photos"
        seen = "photos that the fit has seen" if has_target else "patches of photos that the fits have not seen"
        note(f"quality: measured on {seen}, because {why}; new views look worse")
    return None


@record_part()
def build_left_out(build: Build, left_out: LeftOut, plan: Plan, count: int | None) -> Candidate:
    """Build a candidate without some views, by a ``plan`` for the other views, and score it on the left-out photos.

    ``count`` is the number of Gaussians of the whole scene. The candidate has the share of it that the other views have
    of all views.
    """
    assert count is not None
    begin_part()
    fitted = build(left_out.rest, plan, left_out.reduce(count))
    with stage("score"):
        psnr = mean_seen(left_out.score(fitted.gaussians), left_out.shares)
    return Candidate(count, fitted, fitted.gaussians, fitted.cameras, psnr, current_record(), psnr)


def choose_count(prepared: Prepared, plan: Plan, build: Build, left_out: LeftOut | None, most: int) -> int | None:
    """Choose the number of Gaussians by the budget or the scene's curve; None: ``superpixels`` and K decide.

    ``left_out``: photos that the curve is measured on; None: patches of all photos. ``most``: largest count of the
    curve.
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


def level_counts(finest: int, plan: Plan) -> list[int]:
    """Return the numbers of Gaussians of the coarser levels; none is below the least allowed count."""
    counts = [finest // LEVEL_FACTOR**i for i in range(1, plan.levels)]
    return [count for count in counts if count >= plan.limits.min_count]


def next_count(
    tried: Mapping[int, float], target: float, least: int, most: int, slope: float = PHOTOS_SLOPE, near: float = 0.0
) -> int:
    """Choose the next count to try in the search for the fewest Gaussians that reach a PSNR, within 15 %.

    ``tried`` has the PSNR (dB) of at least one count. The PSNR is assumed to rise with the count. A count that is in
    ``tried`` ends the search; the search also ends at a count at most ``near`` dB above the target. ``slope``: dB per
    doubling that are assumed until two counts were tried.
    """
    above = min((c for c, psnr in tried.items() if psnr >= target), default=None)
    below = max((c for c, psnr in tried.items() if psnr < target and (above is None or c < above)), default=None)
    if above is not None and tried[above] <= target + near:
        return above
    if above is not None and below is not None:
        if above <= below * SAME_COUNT_RATIO:
            return above
        width = float(log(above / below))  # of the interval between the two counts; PSNR is linear in it
        rise = (min(tried[above], target + FAR_DB) - tried[below]) / width
        step = (target - tried[below]) / rise if rise > 0 else width / 2
        return round(below * float(exp(min(max(step + 0.1 * width, 0.15 * width), 0.85 * width))))
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
