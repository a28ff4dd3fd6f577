"""Parts of a run and their costs, from which the seconds left are forecast.

The unit is one pixel of a photo that one step of a fit draws, which takes .06 microseconds of one processor. Only the
ratios of costs matter here, because :mod:`gsmerge.runtime.time_left` measures the seconds during the run. The estimate
before a run, :mod:`gsmerge.runtime.estimate`, has costs in seconds, which are means of other runs and settings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gsmerge.budget import LEVEL_FACTOR
from gsmerge.facts.prepare import Prepared
from gsmerge.plan import Plan
from gsmerge.runtime.record import expect_parts
from gsmerge.runtime.time_left import Part
from gsmerge.stages.pair_merge import POWERS

# Costs, measured on three captures
GAUSSIAN = 12  # for each Gaussian of the result, in one step
BEFORE = 6  # for each pixel of all views: from superpixels to Gaussians
AFTER = 3  # for each pixel of all views: pruning, filling and scores
INPUT = 8  # for each pixel of a view in which the input is scored
PAIRS = 45  # for each Gaussian of a scene whose neighbours are merged pair by pair
PLACED_PIXELS = 1 << 18  # largest number of pixels of a placed view
USUAL_TRIES = 3  # counts that a search usually builds


@dataclass(frozen=True, eq=False)
class RunForecast:
    """Forecast of what a run with a plan still has to do, stage by stage of the search."""

    prepared: Prepared
    plan: Plan
    trial: Part | None  # The trial on views that are left out; None: there is none

    def expect_curve(self, counts: Sequence[int], steps: int, default: int) -> None:
        """Expect a curve of short fits, one for each of the ``counts``, and then the usual result."""
        curve = [build_part(self.prepared, self.plan, count, steps=steps) for count in counts]
        expect_parts([*curve, build_part(self.prepared, self.plan, default), *self._end(self._levels)])

    def expect_builds(self, count: int | None, *, tries: int = 1, again: bool = False) -> None:
        """Expect ``tries`` builds of a count, with ``again`` one more for the result, and what follows a result."""
        build = build_part(self.prepared, self.plan, count)
        expect_parts([*[build] * (tries + again), *self._end(self._levels)])

    def expect_end(self, levels: Sequence[int]) -> None:
        """Expect what follows a result: coarser levels of these counts, a trial, the scores of the input."""
        expect_parts(self._end(levels))

    @property
    def _levels(self) -> list[int]:
        """Expected counts of the coarser levels of detail."""
        return [self.plan.limits.default // LEVEL_FACTOR**level for level in range(1, self.plan.levels)]

    def _end(self, levels: Sequence[int]) -> list[Part]:
        """Return the costs of what follows a result."""
        scored_pixels = self.prepared.scene.pixels_per_view * len(self.plan.scored_views)
        coarser = [build_part(self.prepared, self.plan, count) for count in levels]
        return [*coarser, *([] if self.trial is None else [self.trial]), Part(INPUT * scored_pixels)]


def build_part(prepared: Prepared, plan: Plan, count: int | None, *, steps: int | None = None) -> Part:
    """Return the cost of building ``count`` Gaussians with a fit of ``steps`` steps; None: as the plan says."""
    scene = prepared.scene
    steps = (0 if plan.fit.fit == "none" else plan.fit.steps) if steps is None else steps
    number = min(len(scene.gaussians), plan.limits.default if count is None else count)
    pixels, all_pixels = scene.pixels_per_view, scene.pixels_per_view * len(scene)
    before, after, num_fits = BEFORE * all_pixels, AFTER * all_pixels, 1
    if plan.merges_pairs:
        before, after = PAIRS * len(scene.gaussians), 0
        if prepared.reference.placed:
            pixels, num_fits = min(len(scene.gaussians), PLACED_PIXELS), len(POWERS)
    return Part(before, num_fits * fit_cost(steps, pixels, number), after, num_fits)


def fit_cost(steps: int, pixels: float, count: float) -> float:
    """Return the cost of ``steps`` steps on views of ``pixels`` pixels, with ``count`` Gaussians."""
    return steps * (pixels + GAUSSIAN * count)
