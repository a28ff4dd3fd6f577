"""Processor seconds of a run and of its parts: an estimate before the run adds them up, and its progress weighs them.

They are means of whole runs, on any settings, and right within a factor of about two.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsmerge.compaction.curve import curve_counts
from gsmerge.facts.counts import LEVEL_FACTOR, CountLimits
from gsmerge.measure.coverage import shares_inside
from gsmerge.runtime.record import RunPart
from gsmerge.settings.compact import OURS
from gsmerge.types import Scene

IMPORT_SECONDS = 1.0  # imports, and the constant part of every run
# For each million pixels of all views together, or each million Gaussians if there are more of these:
COST_BUILD = 1.0  # superpixels, merging and scores of a result
COST_INPUT = 0.3  # reading and scoring the input
COST_NETWORKS = 1.4  # the shipped networks
COST_PAPER = 4.5  # the paper's networks, which have more inputs and refine
COST_PAIRS = 3.0  # merging neighbours pair by pair
COST_PLACED = 6.0  # drawing a scene without views from placed ones
COST_SLOW = {"greedy": 25.0, "splat-transform": 60.0}  # in addition
# For each step of the fit:
COST_STEP = 0.1  # per million pixels of its view
COST_DRAWN = 0.25  # per million Gaussians that it draws
THREAD_GAIN = 0.35  # speed of each thread after the first, relative to the first
TRIAL_SHARE = 0.25  # of the trial that estimates new views, as a share of building the result
# Counts that a search usually builds, by photos and by renders of the input
USUAL_BUILDS, USUAL_BUILDS_OF_RENDERS = 3, 1
INSIDE_GAUSSIANS = 10_000  # from which the mean share inside a view is estimated
PLACED_PIXELS = 1 << 18  # largest number of pixels of a placed view


@dataclass(frozen=True, eq=False)
class RunCosts:
    """Facts about a run from which its costs follow."""

    settings: Mapping[str, Any]  # All settings by flat name, with the networks in use
    num_pixels: int  # Of all views together, or the number of Gaussians if that is larger
    view_pixels: float
    inside: float  # Share of the result's Gaussians that a view draws
    steps: int  # Of a fit; 0 without
    merges_pairs: bool = False
    is_placed: bool = False  # The views are placed, since the scene has none

    def build(self, count: float, steps: int | None = None) -> RunPart:
        """Return the part that builds ``count`` Gaussians, with a fit of ``steps`` (None: as the run)."""
        settings, steps = self.settings, self.steps if steps is None else steps
        method = settings["method"]
        work = COST_PAIRS if self.merges_pairs else COST_BUILD
        work += COST_SLOW.get(settings["segmentation"] if method == OURS else method, 0.0)
        if method == OURS and settings["checkpoint"] != "none":
            work += COST_PAPER if "paper" in (settings["recipe"], settings["checkpoint"]) else COST_NETWORKS
        view_pixels = min(self.num_pixels, PLACED_PIXELS) if self.is_placed else self.view_pixels
        step = COST_STEP * view_pixels + COST_DRAWN * self.inside * count
        return RunPart(self.num_pixels * work / 1e6, steps * step / 1e6)

    def end(self, counts: Sequence[float], trial: RunPart | None) -> list[RunPart]:
        """Return the parts that follow a result: levels of ``counts`` Gaussians, a trial, the scores of the input."""
        work = COST_PLACED if self.is_placed else COST_INPUT
        return [*map(self.build, counts), *([] if trial is None else [trial]), RunPart(self.num_pixels * work / 1e6)]

    def trial(self, count: float) -> RunPart:
        """Return the part of the trial that estimates new views of ``count`` Gaussians, in two rounds."""
        build = self.build(count)
        return RunPart(TRIAL_SHARE * build.stages, TRIAL_SHARE * build.fits, 2)

    def seconds(self, parts: Sequence[RunPart], num_views: int, threads: int) -> float:
        """Return the wall time of a run with these parts, imports included."""
        work = sum(part.seconds for part in parts)
        return IMPORT_SECONDS + work / (1 + THREAD_GAIN * max(0, min(threads, num_views) - 1))


@dataclass(frozen=True)
class CountChoice:
    """How a run chooses the number of Gaussians; by default, the options state it."""

    has_target: bool = False  # Numbers are tried until a PSNR is met
    has_curve: bool = False  # The scene's curve is measured first, unless a PSNR has to be met
    max_drop: float | None = None  # Largest loss (dB) that is searched for on the curve; None: its knee
    rendered: bool = False  # Renders of the input stand for photos, which a curve needs


def mean_inside(scene: Scene) -> float:
    """Measure the mean share of a scene's Gaussians that lie in a view, on a sample; 1 without views."""
    return float(np.mean(shares_inside(scene, INSIDE_GAUSSIANS) or [1.0]))


def expected_parts(
    costs: RunCosts, limits: CountLimits, count: float, choice: CountChoice, *, has_trial: bool
) -> list[RunPart]:
    """Return the parts of a run for a result of ``count`` Gaussians; ``has_trial``: a trial estimates new views."""
    builds = 1
    if choice.has_target:
        builds = USUAL_BUILDS_OF_RENDERS if choice.rendered else USUAL_BUILDS
    parts = [costs.build(count)] * builds
    if choice.has_curve and not (choice.has_target or choice.rendered):
        counts, steps = curve_counts(choice.max_drop, limits.default, limits.min_count, limits.max_count)
        parts = [*(costs.build(tried, steps) for tried in counts), *parts]
    coarser = [count / LEVEL_FACTOR**level for level in range(1, costs.settings["levels"])]
    return [*parts, *costs.end(coarser, costs.trial(count) if has_trial else None)]
