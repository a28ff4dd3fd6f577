"""Pruning by chance."""

from __future__ import annotations

import numpy as np

from gsmerge.baselines.baseline import Baseline, own_gaussians
from gsmerge.build import Source
from gsmerge.options import CompactOptions
from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.group import Canvas
from gsmerge.types import Gaussians


def run(source: Source, canvas: Canvas, options: CompactOptions, count: int, log: RunLog) -> Gaussians:
    """Any of them, unchanged and in their order; the seed says which."""
    gaussians = own_gaussians(source)
    with log.stage("reduce"):
        rng = np.random.default_rng(options.seed)
        return gaussians[np.sort(rng.choice(len(gaussians), min(count, len(gaussians)), replace=False))]


RANDOM = Baseline("random", "keep a random choice", run)
