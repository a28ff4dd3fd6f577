"""The input after the full fit that ours gets: what merging has to be better than."""

from __future__ import annotations

from dataclasses import fields, replace

from gsmerge.baselines.baseline import Baseline, own_gaussians
from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.fit import FitOptions, fit_scene
from gsmerge.stages.prepare import PreparedScene
from gsmerge.types import Gaussians


def fit_input(prepared: PreparedScene, options: FitOptions, log: RunLog) -> Gaussians:
    """All Gaussians, fitted to the photos; those that no photo shows make way for others, so the number stays."""
    gaussians = own_gaussians(prepared.scene)
    return fit_scene(gaussians, prepared.scene, options, len(gaussians), seed=prepared.options.seed, log=log)


def run(prepared: PreparedScene, count: int, log: RunLog) -> Gaussians:
    """As many steps as ours by default, as much time with a time budget; whatever the count."""
    return fit_input(prepared, replace(prepared.options.fit, fit="full"), log)


UNMERGED_FIT = Baseline(
    "unmerged-fit",
    "the input after the same full fit",
    run,
    needs=("photos",),
    uses=tuple(f.name for f in fields(FitOptions) if f.name != "fit"),
)
