"""Estimate the seconds of a run, as ``inspect`` and ``--dry-run`` show them, and the parts of its progress.

The costs below are means over whole runs with various settings. Estimates are right within a factor of about two.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gsmerge.plan import Plan
from gsmerge.prepare.prepare_scene import Prepared
from gsmerge.prepare.row_colors import RENDERS
from gsmerge.runtime.record import RunPart
from gsmerge.settings.compact import OURS

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
# Work of the stages of a build, and of scoring the input, for each view, in steps of a fit
STAGE_STEPS, INPUT_STEPS = 10.0, 3.0
PLACED_PIXELS = 1 << 18  # largest number of pixels of a placed view


@dataclass(frozen=True, eq=False)
class RunCosts:
    """Facts about a run that decide how many seconds it takes."""

    settings: Mapping[str, Any]  # All settings by flat name, with the networks in use
    num_pixels: int  # Pixels of all views together, or the number of Gaussians if it is larger
    view_pixels: float  # Pixels of one view
    inside: float  # Share of the result's Gaussians that a view draws
    steps: int  # Steps of a fit; 0 without a fit
    merges_pairs: bool = False  # Neighbours are merged pair by pair, instead of superpixels
    is_placed: bool = False  # The views are placed, since the scene has none
    num_builds: int = 1  # Results that are built until one has the quality that is asked for
    curve: tuple[Sequence[int], int] = ((), 0)  # Counts and steps of the short fits of the scene's curve
    has_trial: bool = False  # A trial estimates the quality of new views

    def build_seconds(self, count: float, steps: int) -> float:
        """Return the processor seconds to build ``count`` Gaussians with a fit of ``steps``."""
        settings, method = self.settings, self.settings["method"]
        work = COST_PAIRS if self.merges_pairs else COST_BUILD
        work += COST_SLOW.get(settings["segmentation"] if method == OURS else method, 0.0)
        if method == OURS and settings["checkpoint"] != "none":
            work += COST_PAPER if "paper" in (settings["recipe"], settings["checkpoint"]) else COST_NETWORKS
        view_pixels = min(self.num_pixels, PLACED_PIXELS) if self.is_placed else self.view_pixels
        return (self.num_pixels * work + steps * (COST_STEP * view_pixels + COST_DRAWN * self.inside * count)) / 1e6

    def seconds(self, count: float, coarser: Iterable[float], num_views: int, threads: int) -> float:
        """Return the wall time of a run for ``count`` Gaussians, and for the ``coarser`` levels, with imports."""
        build, (curve_counts, curve_steps) = self.build_seconds(count, self.steps), self.curve
        work = build * (self.num_builds + TRIAL_SHARE * self.has_trial)
        work += sum(self.build_seconds(point_count, curve_steps) for point_count in curve_counts)
        work += sum(self.build_seconds(level_count, self.steps) for level_count in coarser)
        work += self.num_pixels * (COST_PLACED if self.is_placed else COST_INPUT) / 1e6
        return IMPORT_SECONDS + work / (1 + THREAD_GAIN * max(0, min(threads, num_views) - 1))


def usual_builds(*, has_target: bool, rendered: bool) -> int:
    """Return how many results a run usually builds; ``rendered``: renders of the input stand for photos."""
    return (USUAL_BUILDS_OF_RENDERS if rendered else USUAL_BUILDS) if has_target else 1


def run_parts(prepared: Prepared, plan: Plan) -> list[RunPart]:
    """Return the parts that a run in one piece is expected to have, in their order, after the fits of a curve."""
    views, steps = len(prepared.scene), 0 if plan.fit.fit == "none" else plan.fit.steps
    build = RunPart("build", STAGE_STEPS * views, steps)
    count = usual_builds(has_target=plan.target_psnr is not None, rendered=prepared.reference.name == RENDERS)
    trial = RunPart("trial", TRIAL_SHARE / 2 * build.stages, TRIAL_SHARE / 2 * steps)  # one of two rounds
    parts = [build] * (count + plan.levels - 1)
    return [*parts, RunPart("input", INPUT_STEPS * views), *([trial] * 2 if plan.new_views else [])]
