"""Fitted Gaussians -> candidate: the Gaussians in the world, with their PSNR."""

from __future__ import annotations

from gsmerge.frozen import dataclass, replace
from gsmerge.io.cameras.camera_file import describe_moves, list_moves
from gsmerge.method.facts.pictures import RENDERS
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.fit import Fitted
from gsmerge.method.geometry.frame import scene_depth
from gsmerge.method.pipelines.plan import Plan, ScorePlan
from gsmerge.plan.make_plan import pictured_views
from gsmerge.results.scores import compares_all_pixels, measure_renders, measure_result, round_for_output
from gsmerge.runtime.record import Record, current_record, note, record_choices, record_part, stage
from gsmerge.types import Cameras, Gaussians


@dataclass(frozen=True, eq=False)
class Candidate:
    """Gaussians built for one count, with their PSNR; a search compares several candidates."""

    count: int | None  # Number of Gaussians that was asked for; None: `superpixels` and K decide it
    fitted: Fitted  # Fitted canonical Gaussians
    gaussians: Gaussians  # The same Gaussians in the world
    cameras: Cameras  # The given views in the world; their poses are those of the fit
    psnr: float | None  # Mean PSNR (dB) of the scored views, against photos or renders of the input; None without views
    record: Record  # Seconds, choices and notes of building and scoring it
    # PSNR (dB) that a search compares with its target. If the input leaves gaps, only the pixels that it covers count
    deciding_psnr: float | None = None
    unmet: str | None = None  # Why it does not meet the target of a search; None if it does, or without a target


def make_candidate(fitted: Fitted, prepared: Prepared, plan: Plan, count: int | None = None) -> Candidate:
    """Move fitted canonical Gaussians into the world, and measure their PSNR; ``count`` is the number asked for."""
    moved = with_moved_views(prepared, fitted.cameras)
    gaussians = moved.frame.leave(fitted.gaussians)
    cameras = moved.input_scene.cameras
    if cameras is not prepared.input_scene.cameras:
        input_scene = prepared.input_scene
        cause = "poses are free" if plan.free_poses else "the photos of some views agree only under other poses"
        depth = scene_depth(prepared.scene) * prepared.frame.unit
        moves = list_moves(input_scene.names, input_scene.cameras.viewmats, cameras.viewmats, depth)
        record_choices(poses=moves)
        note(f"{cause}: cameras were moved by {describe_moves(moves)}")
    psnr, deciding_psnr = _measure_candidate(gaussians, moved, plan.score)
    return Candidate(
        count, fitted=fitted, gaussians=gaussians, cameras=cameras, psnr=psnr, record=current_record(),
        deciding_psnr=deciding_psnr,
    )  # fmt: skip


def rescore(candidate: Candidate, gaussians: Gaussians, prepared: Prepared, plan: Plan) -> Candidate:
    """Return the candidate with only ``gaussians``, which are some or all of its Gaussians, and with their PSNR."""
    with record_part(silent=True) as record:
        moved = with_moved_views(prepared, candidate.fitted.cameras)
        psnr, _ = _measure_candidate(gaussians, moved, plan.score)
    candidate.record.choices.update(record.choices)
    return replace(candidate, gaussians=gaussians, psnr=psnr)


def _measure_candidate(gaussians: Gaussians, moved: Prepared, plan: ScorePlan) -> tuple[float | None, float | None]:
    """Return ``psnr`` and ``deciding_psnr`` of a candidate with ``gaussians``, which are in the world frame.

    Both PSNR are measured against photos, or against renders of the input if the renders stand for photos. Both PSNR
    are None without photos and renders. ``moved`` is the scene with the cameras of the fit.
    """
    if moved.reference.name == RENDERS:
        canonical = moved.frame.enter(round_for_output(gaussians, plan))
        with stage("score"):
            compared = measure_renders(canonical, moved, plan)
        # If the input leaves gaps, only the pixels that it covers count
        fidelity = compared.psnr if plan.covered is None else compared.covered_psnr
        views = len(plan.views)
        placed = moved.reference.placed
        record_choices(fidelity={"psnr": fidelity, "views": views, "held_out": placed})
        return fidelity, fidelity
    measured = measure_result(gaussians, moved, plan, None if plan.before is None else plan.before.covered)
    if measured is None:
        return None, None
    record_choices(scored_views=len(plan.views), scored_all=not plan.samples and plan.views == pictured_views(moved))
    return measured.psnr, measured.psnr if compares_all_pixels(plan.before) else measured.covered_psnr


def with_moved_views(prepared: Prepared, cameras: Cameras) -> Prepared:
    """Return a prepared scene whose views have the canonical ``cameras`` of a fit.

    The views of the input, which are in the world frame, move in the same way. If the fit moved no camera, the input's
    cameras stay the same object.
    """
    prepared = prepared.with_cameras(cameras)
    input_cameras = prepared.final_cameras()
    if input_cameras is prepared.input_scene.cameras:
        return prepared
    return replace(prepared, input_scene=replace(prepared.input_scene, cameras=input_cameras))
