"""The pipeline of bare rows, which no photo shows: neighbours are merged pair by pair, and fitted to renders of them.

scene -> merged -> fitted
"""

from __future__ import annotations

from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.fit import Fitted
from gsmerge.method.pipelines.plan import Pipeline, Plan
from gsmerge.method.stages.fit_pairs import fit_around, merge_scene


def build_from_pairs(prepared: Prepared, plan: Plan, count: int | None) -> Fitted:
    """Merge neighbouring Gaussians pair by pair until ``count`` remain, and fit them to renders of the scene.

    None: the usual number. A scene of at most ``count`` Gaussians is returned unchanged, because its renders show
    exactly these Gaussians.
    """
    start = merge_scene(plan.count.limits.default if count is None else count, plan.merge.power, prepared)
    if start.is_input:
        return Fitted(start.gaussians, prepared.scene.cameras, None)
    return fit_around(start, prepared, plan.fit, plan.seed)


BARE_ROWS = Pipeline("bare rows", build_from_pairs)
