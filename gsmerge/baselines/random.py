"""Pruning by chance."""

from __future__ import annotations

import numpy as np

from gsmerge.baselines.baseline import Baseline, own_gaussians
from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.prepare import PreparedScene
from gsmerge.types import Gaussians


def run(prepared: PreparedScene, count: int, log: RunLog) -> Gaussians:
    """Any of them, unchanged and in their order; the seed says which."""
    gaussians = own_gaussians(prepared.scene)
    with log.stage("reduce"):
        rng = np.random.default_rng(prepared.options.seed)
        return gaussians[np.sort(rng.choice(len(gaussians), min(count, len(gaussians)), replace=False))]


RANDOM = Baseline("random", "keep a random choice", run)
