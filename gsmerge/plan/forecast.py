"""The parts that a run is expected to have, with their work."""

from __future__ import annotations

from gsmerge.method.facts.pictures import RENDERS
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.pipelines.plan import Plan
from gsmerge.runtime.record import RunPart

# Number of candidates that a search usually builds: first, if photos score them; second, if renders of the input do
USUAL_BUILDS = 3
USUAL_BUILDS_OF_RENDERS = 2
# Work of the stages of a build, and of scoring the input, for each view, in steps of a fit
STAGE_STEPS = 10.0
INPUT_STEPS = 3.0
# Cost of the trial that estimates new views, as a share of building the result; cost of building a coarser level of
# detail, as a share of building the next finer level
TRIAL_SHARE = 0.25
LEVEL_SHARE = 0.6


def usual_builds(*, has_target: bool, rendered: bool) -> int:
    """Return how many results a run usually builds; ``rendered``: renders of the input stand for photos."""
    if not has_target:
        return 1
    return USUAL_BUILDS_OF_RENDERS if rendered else USUAL_BUILDS


def run_parts(prepared: Prepared, plan: Plan) -> list[RunPart]:
    """Return the parts that a run in one piece is expected to have, in their order, after the fits of a curve."""
    views = len(prepared.scene)
    steps = 0 if plan.fit.fit == "none" else plan.fit.steps
    build = RunPart("build", STAGE_STEPS * views, steps)
    count = usual_builds(has_target=plan.count.target_psnr is not None, rendered=prepared.reference.name == RENDERS)
    trial = RunPart("trial", TRIAL_SHARE * build.stages, TRIAL_SHARE * steps)
    shares = [1.0] * count + [LEVEL_SHARE**level for level in range(1, plan.count.levels)]
    return [
        *(RunPart("build", share * build.stages, share * steps) for share in shares),
        RunPart("input", INPUT_STEPS * views), *([trial] if plan.score.new_views else []),
    ]  # fmt: skip
