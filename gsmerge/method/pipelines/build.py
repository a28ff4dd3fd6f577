"""Prepared scene -> fitted Gaussians, by the pipeline that the plan of the run has chosen."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.fit import Fitted
from gsmerge.method.pipelines.plan import Pipeline, Plan
from gsmerge.types import Gaussians

Run = Callable[[Prepared, Plan, int], Gaussians]  # builds at most a number of canonical Gaussians


def build(prepared: Prepared, plan: Plan, count: int | None) -> Fitted:
    """Build and fit ``count`` canonical Gaussians; None: the settings decide the number."""
    return plan.pipeline.build(prepared, plan, count)


def make_pipeline(name: str, run: Run) -> Pipeline:
    """Make a pipeline of the method ``run`` of another package."""
    return Pipeline(name, partial(_build_by, run))


def _build_by(run: Run, prepared: Prepared, plan: Plan, count: int | None) -> Fitted:
    """Build Gaussians by a method, which moves no cameras and has no report of a fit."""
    gaussians = run(prepared, plan, plan.count.limits.default if count is None else count)
    return Fitted(gaussians, prepared.scene.cameras, None)
