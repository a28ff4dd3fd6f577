"""fitted -> candidate: Gaussians that were built for one count, in the world, with their score."""

from __future__ import annotations

from dataclasses import dataclass, replace

from gsmerge.compaction.scores import covers_all, measure_renders, measure_result, written
from gsmerge.facts.prepare import Prepared
from gsmerge.fit import Fitted
from gsmerge.geometry.frame import scene_depth
from gsmerge.io.cameras.camera_file import describe_moves, list_moves
from gsmerge.photos.row_colors import RENDERS
from gsmerge.plan import Plan, own_views
from gsmerge.runtime.record import Record, current_record, note, record_choices, record_part, stage
from gsmerge.types import Cameras, Gaussians


@dataclass(frozen=True, eq=False)
class Candidate:
    """Gaussians built for one count, with their score."""

    count: int | None  # Gaussians that were asked for; None: as many as `superpixels` and K give
    fitted: Fitted  # Fitted canonical Gaussians
    gaussians: Gaussians  # The same in the world
    cameras: Cameras  # The given views in the world; their poses are those of the fit
    psnr: float | None  # Mean PSNR (dB) of the scored views, against photos or renders of the input; None without views
    record: Record  # Seconds, choices and notes of building and scoring it
    # PSNR (dB) that decides the count: over the pixels that the input covers, if it does not cover all
    deciding_psnr: float | None = None


def score(count: int | None, fitted: Fitted, prepared: Prepared, plan: Plan) -> Candidate:
    """Move canonical Gaussians into the world, and measure the PSNR."""
    moved = with_moved_views(prepared, fitted.cameras)
    gaussians, cameras = moved.frame.leave(fitted.gaussians), moved.input_scene.cameras
    if cameras is not prepared.input_scene.cameras:
        _note_moves(prepared, cameras, plan)
    psnr, deciding_psnr = _measure_candidate(gaussians, moved, plan)
    return Candidate(count, fitted, gaussians, cameras, psnr, current_record(), deciding_psnr)


def rescore(candidate: Candidate, gaussians: Gaussians, prepared: Prepared, plan: Plan) -> Candidate:
    """Replace a candidate's Gaussians by all or some of them, and measure its PSNR again."""
    with record_part(silent=True) as record:
        psnr, _ = _measure_candidate(gaussians, with_moved_views(prepared, candidate.fitted.cameras), plan)
    choices = candidate.record.choices | record.choices
    return replace(candidate, gaussians=gaussians, psnr=psnr, record=replace(candidate.record, choices=choices))


def _measure_candidate(gaussians: Gaussians, moved: Prepared, plan: Plan) -> tuple[float | None, float | None]:
    """Measure two PSNR (dB) of Gaussians of the world: of the scored views, and the one that decides the count.

    Both are against photos, or against renders of the input if these stand for photos; None without either.
    """
    if moved.reference.name == RENDERS:
        fidelity = _measure_fidelity(moved.frame.enter(written(gaussians, plan)), moved, plan)
        views, placed = len(plan.scored_views), moved.reference.placed
        record_choices(fidelity={"psnr": fidelity, "views": views, "held_out": placed})
        return fidelity, fidelity
    measured = measure_result(gaussians, moved, plan, None if plan.before is None else plan.before.covered)
    if measured is None:
        return None, None
    record_choices(
        scored_views=len(plan.scored_views), scored_all=not plan.samples and plan.scored_views == own_views(moved)
    )
    return measured.psnr, measured.psnr if covers_all(plan.before) else measured.covered_psnr


@stage("score")
def _measure_fidelity(gaussians: Gaussians, prepared: Prepared, plan: Plan) -> float:
    """Measure the mean PSNR (dB), at most 120, of canonical Gaussians against renders of the input, where it covers."""
    measured = measure_renders(gaussians, prepared, plan)
    return measured.psnr if plan.covered is None else measured.covered_psnr


def with_moved_views(prepared: Prepared, cameras: Cameras) -> Prepared:
    """Move the input views to the canonical ``cameras`` of a fit; return the scene unchanged if the fit moved none."""
    prepared = prepared.with_cameras(cameras)
    final = prepared.final_cameras()
    if final is prepared.input_scene.cameras:
        return prepared
    return replace(prepared, input_scene=replace(prepared.input_scene, cameras=final))


def _note_moves(prepared: Prepared, cameras: Cameras, plan: Plan) -> None:
    """Add a note on how far each camera was moved."""
    input_scene = prepared.input_scene
    cause = "poses are free" if plan.free_poses else "the photos of some views agree only under other poses"
    depth = scene_depth(prepared.scene) * prepared.frame.unit
    moves = list_moves(input_scene.names, input_scene.cameras.viewmats, cameras.viewmats, depth)
    record_choices(poses=moves)
    note(f"{cause}: cameras were moved by {describe_moves(moves)}")
