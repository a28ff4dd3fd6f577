"""Pruning by what a Gaussian adds to the views: its blending weights, summed over all of them (Mini-Splatting)."""

from __future__ import annotations

import numpy as np

from gsmerge.baselines.baseline import Baseline, most_important, own_gaussians
from gsmerge.render import contributions, plan_view, prepare
from gsmerge.runtime.run_log import RunLog
from gsmerge.runtime.threads import parallel_map
from gsmerge.stages.prepare import PreparedScene
from gsmerge.types import Cameras, Gaussians

AT_ONCE = 2_000_000  # Gaussians in the plans of the views under way: each plan is as large as they are


def summed_weights(gaussians: Gaussians, cameras: Cameras) -> np.ndarray:
    """``[n]`` float64 blending weights summed over the pixels of all views; the same on any number of threads."""
    splats = prepare(gaussians)
    viewmats, Ks = cameras.viewmats.double().numpy(), cameras.Ks.double().numpy()

    def one_view(view: int) -> np.ndarray:
        sums, _ = contributions(plan_view(splats, viewmats[view], Ks[view], cameras.width, cameras.height))
        return sums

    total, step = np.zeros(len(splats)), max(1, AT_ONCE // max(len(splats), 1))
    for first in range(0, len(cameras), step):
        for sums in parallel_map(one_view, range(first, min(first + step, len(cameras)))):
            total += sums
    return total


def run(prepared: PreparedScene, count: int, log: RunLog) -> Gaussians:
    """Those that show most, unchanged and in their order; of equal ones the first of the file."""
    gaussians = own_gaussians(prepared.scene)
    with log.stage("reduce"):
        return gaussians[most_important(summed_weights(gaussians, prepared.scene.cameras), count)]


CONTRIBUTION = Baseline("contribution", "keep those with the largest summed blending weight", run)
