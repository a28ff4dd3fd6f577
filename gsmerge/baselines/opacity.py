"""Pruning by opacity."""

from __future__ import annotations

from gsmerge.baselines.baseline import Baseline, most_important, own_gaussians
from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.prepare import PreparedScene
from gsmerge.types import Gaussians


def run(prepared: PreparedScene, count: int, log: RunLog) -> Gaussians:
    """The most opaque, unchanged and in their order; of equal ones the first of the file."""
    gaussians = own_gaussians(prepared.scene)
    with log.stage("reduce"):
        return gaussians[most_important(gaussians.opacities, count)]


OPACITY = Baseline("opacity", "keep the most opaque", run)
