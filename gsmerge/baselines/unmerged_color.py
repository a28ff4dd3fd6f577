"""The input with colours solved on the photos."""

from __future__ import annotations

from dataclasses import replace

from gsmerge.baselines.baseline import Baseline
from gsmerge.baselines.unmerged_fit import fit_input
from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.prepare import PreparedScene
from gsmerge.types import Gaussians


def run(prepared: PreparedScene, count: int, log: RunLog) -> Gaussians:
    """The colour fit on all Gaussians, none left out; whatever the count."""
    return fit_input(prepared, replace(prepared.options.fit, fit="color", min_contribution=0.0), log)


UNMERGED_COLOR = Baseline(
    "unmerged-color",
    "the input with colours solved on the photos",
    run,
    needs=("photos",),
    uses=("iterations", "prior_weight", "huber", "min_gain", "max_gain", "holdout"),
)
