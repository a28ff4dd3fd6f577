"""The input as it is."""

from __future__ import annotations

from gsmerge.baselines.baseline import Baseline, own_gaussians
from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.prepare import PreparedScene
from gsmerge.types import Gaussians


def run(prepared: PreparedScene, count: int, log: RunLog) -> Gaussians:
    """All Gaussians, whatever the count."""
    return own_gaussians(prepared.scene)


UNMERGED = Baseline("unmerged", "the input as it is", run, uses=())
