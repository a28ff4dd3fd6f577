"""The input with colours solved on the photos."""

from __future__ import annotations

from dataclasses import replace

from gsmerge.baselines.baseline import Baseline
from gsmerge.baselines.unmerged_fit import fitted_input
from gsmerge.build import Source
from gsmerge.options import CompactOptions
from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.group import Canvas
from gsmerge.types import Gaussians


def run(source: Source, canvas: Canvas, options: CompactOptions, count: int, log: RunLog) -> Gaussians:
    """The colour fit on all Gaussians, none left out; whatever the count."""
    return fitted_input(source, replace(options.fit, fit="color", prune=0.0), options.seed, log)


UNMERGED_COLOR = Baseline(
    "unmerged-color",
    "the input with colours solved on the photos",
    run,
    needs=("photos",),
    uses=("iterations", "pull", "huber", "min_gain", "max_gain", "holdout"),
)
