"""How long a grid will take, before it is run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median

from gsmerge.research.charts.experiment import OURS, Experiment
from gsmerge.research.charts.places import Place
from gsmerge.research.charts.record import INPUT, RunRecord
from gsmerge.runtime.estimate import (
    COST_BASELINES,
    COST_COLOR_FIT,
    COST_FIT_RENDERS,
    COST_FULL_FIT,
    COST_MERGE,
    COST_OTHER_BASELINE,
    COST_READ,
    COST_ROBUST,
    COST_SEGMENT,
    COST_UNMERGED_STEP,
    score_cost,
)
from gsmerge.stages.fit.options import STEPS

BYTES_PER_GAUSSIAN = 68  # of a .ply without higher harmonics
COST_EVALUATE = 2.5  # scoring input and result: seconds per million pixels of all views
COST_LPIPS = 12.0  # the same for each network


def estimate_seconds(
    runs: Sequence[tuple[str, Experiment, Place]],
    stored: Mapping[str, RunRecord],
    *,
    threads: int,
    lpips: Sequence[str] = (),
    lpips_views: int | None = None,
) -> float:
    """Wall time of runs, within a factor of about two; of merges that the folder has times of, those count.

    Args:
        runs: Key, experiment and scene of what is to be run.
        stored: Finished runs by key, from which times are taken.
        threads: Threads that would run.
        lpips: Networks of the perceptual distance.
        lpips_views: Views of each split that get it; None: all.
    """
    known: dict[tuple[str, str], list[float]] = {}
    for record in stored.values():
        if record.seconds is not None and record.error is None:
            known.setdefault((record.scene, record.method), []).append(record.seconds)
    total = 0.0
    for _, experiment, place in runs:
        pixels = place.files.ply.stat().st_size / BYTES_PER_GAUSSIAN / 1e6
        views = place.num_views or 1
        share = min(1.0, (experiment.views or views) / views)
        looked_at = min(1.0, (lpips_views or views) / max(share * views, 1.0))
        total += share * pixels * (COST_EVALUATE + looked_at * COST_LPIPS * len(lpips)) / threads
        times = known.get((place.name, experiment.method))
        total += share * median(times) if times else _merge_seconds(experiment, share * pixels, views * share, threads)
    places = {place.path: place for _, _, place in runs}
    return total + sum(COST_READ * p.files.ply.stat().st_size / BYTES_PER_GAUSSIAN / 1e6 for p in places.values())


def _merge_seconds(experiment: Experiment, pixels: float, views: float, threads: int) -> float:
    """Of one merge; pixels in millions."""
    if experiment.method == INPUT:
        return 0.0
    settings = experiment.settings
    if experiment.method != OURS:
        return _rival_seconds(experiment.method, STEPS[settings.get("effort", "default")], pixels, views, threads)
    work = pixels * (COST_MERGE + score_cost(views) + COST_SEGMENT[settings.get("segmentation", "rdseg")])
    fit = settings.get("fit", "full")
    if fit == "full":
        work += COST_FULL_FIT * STEPS[settings.get("effort", "default")] * pixels / max(views, 1.0)
        work += pixels * COST_FIT_RENDERS
    else:
        work += pixels * (COST_ROBUST + COST_COLOR_FIT * (fit == "color"))
    return work / threads


def _rival_seconds(method: str, steps: int, pixels: float, views: float, threads: int) -> float:
    """The same of another method than ours."""
    work = COST_BASELINES.get(method, COST_OTHER_BASELINE) + score_cost(views)
    work = pixels * (work + COST_COLOR_FIT * (method == "unmerged-color"))
    if method == "unmerged-fit":
        work += steps * pixels * (COST_FULL_FIT / max(views, 1.0) + COST_UNMERGED_STEP)
    return work / threads
