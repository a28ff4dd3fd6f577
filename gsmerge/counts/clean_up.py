"""Build one of several results of a run, if asked for without floaters, sky and other kinds of Gaussians."""

from __future__ import annotations

import math
from dataclasses import replace

from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.fit import Fitted
from gsmerge.method.pipelines.build import build
from gsmerge.method.pipelines.plan import Plan
from gsmerge.method.stages.clean import clean, describe_counts, faintest_dropped
from gsmerge.results.candidate import Candidate, make_candidate
from gsmerge.runtime.record import Record, add_seconds, adopt, begin_part, note, record_choices, record_part
from gsmerge.types import Gaussians

SURPLUS = 1.05  # Gaussians that are built, relative to the number that has to remain after clean-up


@record_part()
def build_candidate(prepared: Prepared, plan: Plan, count: int | None) -> Candidate:
    """Build one of several results of a run, clean it up as the plan says, and score it, with a record of its own."""
    begin_part("build")
    fitted = build_cleaned(prepared, plan, count) if plan.clean.asked else build(prepared, plan, count)
    return make_candidate(fitted, prepared, plan, count)


def build_cleaned(prepared: Prepared, plan: Plan, count: int | None) -> Fitted:
    """Build Gaussians and clean them up, so that ``count`` Gaussians remain if the scene has so many.

    A few more than ``count`` are built. If too few Gaussians remain after clean-up, all are built once more, with a
    surplus as large as the number that clean-up dropped. If too many Gaussians remain, the faintest are dropped.
    """

    def build_once(built_count: int | None) -> tuple[Fitted, dict[str, int], Record]:
        """Build and clean up once; return what remains, the number of dropped Gaussians by reason, and the record."""
        with record_part() as record:
            fitted = build(prepared, plan, built_count)
            gaussians, dropped = clean_fitted(fitted, prepared, plan)
        add_seconds(record.seconds)
        return replace(fitted, gaussians=gaussians), dropped, record

    max_count = len(prepared.scene.gaussians)
    first_count = None if count is None else min(max_count, math.ceil(SURPLUS * count))
    fitted, dropped, record = build_once(first_count)
    if count is not None and first_count is not None and len(fitted.gaussians) < count and first_count < max_count:
        factor = SURPLUS * count / max(1, len(fitted.gaussians))
        fitted, dropped, record = build_once(min(max_count, math.ceil(factor * first_count)))
    gaussians = fitted.gaussians
    if count is not None and len(gaussians) > count:
        gaussians, dropped = faintest_dropped(gaussians, count), dropped | {"surplus": len(gaussians) - count}
    adopt(record)
    record_dropped(dropped, len(gaussians), count, prepared)
    return replace(fitted, gaussians=gaussians)


def clean_fitted(fitted: Fitted, prepared: Prepared, plan: Plan) -> tuple[Gaussians, dict[str, int]]:
    """Clean up fitted Gaussians; return the remaining Gaussians, and the number of dropped Gaussians by reason."""
    # Cameras that were placed for scores are too few to show all of the scene. If `clean` gets no cameras, it places
    # enough to show the whole scene
    cameras = None if prepared.reference.placed else fitted.cameras[sorted({*prepared.repeated})]
    rows, dropped = clean(fitted.gaussians, plan.clean, cameras, prepared.scene.images, prepared.frame.leave)
    return fitted.gaussians[rows], dropped


def record_dropped(dropped: dict[str, int], remaining: int, count: int | None, prepared: Prepared) -> None:
    """Record the number of dropped Gaussians by reason, with notes, also if fewer than ``count`` remain."""
    record_choices(clean=dropped)
    # The input was cropped before the run. The crop below only removes Gaussians that the fit moved across the border,
    # usually none
    shown = {name: number for name, number in dropped.items() if number or name != "cropped"}
    if shown:
        note(f"left out by clean-up: {describe_counts(shown, placed=prepared.reference.placed)}")
    if dropped.get("sky"):
        note("PSNR of the input views counts the sky that was left out as errors")
    if count is not None and remaining < count:
        note(f"budget: {count:,} Gaussians were asked for, {remaining:,} remain after clean-up")
