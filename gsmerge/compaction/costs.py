"""Estimate the processor seconds of a run and of its parts.

``inspect`` and ``--dry-run`` show the sum as the time of a run. The progress of a run follows the ratios of its parts.
The costs below are means over whole runs with various settings. Estimates are right within a factor of about two.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsmerge.compaction.curve import curve_counts
from gsmerge.compaction.new_views import can_try
from gsmerge.facts.counts import CountLimits, level_counts
from gsmerge.facts.prepare import Prepared
from gsmerge.measure.coverage import shares_inside
from gsmerge.photos.row_colors import RENDERS
from gsmerge.plan import Plan
from gsmerge.runtime.record import RunPart
from gsmerge.settings.compact import OURS
from gsmerge.types import Scene

IMPORT_SECONDS = 1.0  # imports, and the constant part of every run
# Seconds for each million pixels of all views together, or for each million Gaussians if there are more Gaussians than
# pixels:
COST_BUILD = 1.0  # superpixels, merging and scores of a result
COST_INPUT = 0.3  # reading and scoring the input
COST_NETWORKS = 1.4  # the shipped networks
COST_PAPER = 4.5  # the paper's networks, which have more inputs and refine
COST_PAIRS = 3.0  # merging neighbours pair by pair
COST_PLACED = 6.0  # drawing a scene without views from placed views
COST_SLOW = {"greedy": 25.0, "splat-transform": 60.0}  # in addition, for slow methods
# Seconds for each step of the fit:
COST_STEP = 0.1  # per million pixels of its view
COST_DRAWN = 0.25  # per million Gaussians that it draws
THREAD_GAIN = 0.35  # speed of each thread after the first, relative to the first
TRIAL_SHARE = 0.25  # cost of the trial that estimates new views, as a share of building the result
# Number of candidates that a search usually builds: first, if photos score them; second, if renders of the input do
USUAL_BUILDS, USUAL_BUILDS_OF_RENDERS = 3, 1
INSIDE_GAUSSIANS = 10_000  # sample of Gaussians for the mean share that lies inside a view
PLACED_PIXELS = 1 << 18  # largest number of pixels of a placed view


@dataclass(frozen=True)
class CountChoice:
    """How a run chooses the number of Gaussians. If no field is set, the options state the number."""

    has_target: bool = False  # Several candidates are built until one reaches a PSNR
    has_curve: bool = False  # The scene's curve decides, unless ``has_target`` or ``rendered``
    max_drop: float | None = None  # Largest loss of quality (dB) that is allowed on the curve; None: the knee decides
    rendered: bool = False  # Renders of the input stand for photos, so there is no curve


@dataclass(frozen=True, eq=False)
class RunCosts:
    """Facts about a run that decide how many seconds its parts take."""

    settings: Mapping[str, Any]  # All settings by flat name, with the networks in use
    num_pixels: int  # Pixels of all views together, or the number of Gaussians if it is larger
    view_pixels: float  # Pixels of one view
    inside: float  # Share of the result's Gaussians that a view draws
    steps: int  # Steps of a fit; 0 without a fit
    merges_pairs: bool = False  # Neighbours are merged pair by pair, instead of superpixels
    is_placed: bool = False  # The views are placed, since the scene has none
    choice: CountChoice = CountChoice()
    has_trial: bool = False  # A trial estimates the quality of new views

    def all_parts(self, limits: CountLimits, count: int) -> list[RunPart]:
        """Return the parts that a run for about ``count`` Gaussians is expected to have, in their order.

        First come the fits of a curve, if a curve is measured, then the build of the result, or the builds of all
        candidates of a search. The parts of :meth:`end_parts` follow.
        """
        choice = self.choice
        builds_of_search = USUAL_BUILDS_OF_RENDERS if choice.rendered else USUAL_BUILDS
        parts = [self.build_part(count)] * (builds_of_search if choice.has_target else 1)
        if choice.has_curve and not (choice.has_target or choice.rendered):
            counts, steps = curve_counts(choice.max_drop, limits.default, limits.min_count, limits.max_count)
            parts = [*(self.build_part(point_count, steps) for point_count in counts), *parts]
        return [*parts, *self.end_parts(count, level_counts(count, self.settings["levels"], limits.min_count))]

    def build_part(self, count: float, steps: int | None = None) -> RunPart:
        """Return the part that builds ``count`` Gaussians with a fit of ``steps``; None: the run's steps."""
        settings, steps = self.settings, self.steps if steps is None else steps
        method = settings["method"]
        work = COST_PAIRS if self.merges_pairs else COST_BUILD
        work += COST_SLOW.get(settings["segmentation"] if method == OURS else method, 0.0)
        if method == OURS and settings["checkpoint"] != "none":
            work += COST_PAPER if "paper" in (settings["recipe"], settings["checkpoint"]) else COST_NETWORKS
        view_pixels = min(self.num_pixels, PLACED_PIXELS) if self.is_placed else self.view_pixels
        step = COST_STEP * view_pixels + COST_DRAWN * self.inside * count
        return RunPart(self.num_pixels * work / 1e6, steps * step / 1e6)

    def end_parts(self, count: float, coarser: Sequence[float]) -> list[RunPart]:
        """Return the parts that follow after the result is built: coarser levels, a trial, and scores of the input.

        ``count`` is the number of Gaussians of the result, and ``coarser`` has the numbers of the coarser levels. The
        trial has two rounds.
        """
        build = self.build_part(count)
        trial = [RunPart(TRIAL_SHARE * build.stages, TRIAL_SHARE * build.fits, 2)] * self.has_trial
        scores = RunPart(self.num_pixels * (COST_PLACED if self.is_placed else COST_INPUT) / 1e6)
        return [*map(self.build_part, coarser), *trial, scores]

    def seconds(self, parts: Sequence[RunPart], num_views: int, threads: int) -> float:
        """Return the wall time of a run with these parts, which includes imports."""
        work = sum(part.seconds for part in parts)
        return IMPORT_SECONDS + work / (1 + THREAD_GAIN * max(0, min(threads, num_views) - 1))


def mean_inside(scene: Scene) -> float:
    """Return the mean over all views of the share of the scene's Gaussians that lies in the view; 1 without views.

    The share is measured on a sample of the Gaussians.
    """
    return float(np.mean(shares_inside(scene, INSIDE_GAUSSIANS) or [1.0]))


def measure_costs(prepared: Prepared, plan: Plan) -> RunCosts:
    """Return the facts that decide the costs of a run in one piece."""
    scene, steps = prepared.scene, 0 if plan.fit.fit == "none" else plan.fit.steps
    return RunCosts(
        settings=plan.settings | ({} if plan.checkpoint else {"checkpoint": "none"}),
        num_pixels=max(scene.pixels_per_view * len(scene), len(scene.gaussians)),
        view_pixels=scene.pixels_per_view,
        inside=mean_inside(scene),
        steps=steps,
        merges_pairs=plan.merges_pairs,
        is_placed=plan.merges_pairs and prepared.reference.placed,
        choice=CountChoice(
            has_target=plan.target_psnr is not None,
            has_curve=plan.auto_count or plan.max_drop is not None,
            max_drop=plan.max_drop,
            rendered=prepared.reference.name == RENDERS,
        ),
        has_trial=plan.new_views and can_try(prepared),
    )
