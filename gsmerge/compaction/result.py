"""fitted -> result: Gaussians in the world, scored on the input photos, with the report of the run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any
from weakref import ReferenceType

import numpy as np

from gsmerge.arguments import check_arguments
from gsmerge.arrays import to_float32
from gsmerge.compaction.new_views import SIDE, NewViews, Trial
from gsmerge.compaction.outputs import write_result
from gsmerge.compaction.report import CompactReport, Covered, PhotoFiles
from gsmerge.facts.prepare import Prepared
from gsmerge.facts.row_colors import OWN_PHOTOS, PHOTOS, RENDERS
from gsmerge.facts.views import scored_views
from gsmerge.fit import Fitted
from gsmerge.frame import scene_depth
from gsmerge.io.cameras.camera_file import describe_moves, list_moves
from gsmerge.io.formats.rounding import as_written
from gsmerge.plan import Plan
from gsmerge.raster import render
from gsmerge.raster.metrics import describe_distance, describe_loss
from gsmerge.raster.photos import NEAR_PLANE, WHOLE, PhotoScore, scene_photos, score_photos
from gsmerge.runtime.memory import peak_memory
from gsmerge.runtime.record import Record, choose, current_record, note, record_part, stage
from gsmerge.stages.prune import ROUNDING
from gsmerge.types import Cameras, Gaussians, Scene, StrPath, make_scene

if TYPE_CHECKING:
    import torch

    from gsmerge.pages.view import Page


@dataclass(frozen=True)
class CompactResult:
    """The compact Gaussians, in the scene's own world frame, and the report.

    Args:
        gaussians: The Gaussians.
        report: What was done.
        cameras: The given views as the Gaussians were made from them, in the same frame: moved where their poses were
            wrong, see ``poses`` of :class:`gsmerge.settings.stages.PrepareOptions`.
        coarser: Further levels of detail, each with a quarter of the Gaussians of the one before.
        names: Of the views.
        scene: The path of the scene that was given, or a reference to it that does not keep it in memory.

    Example:
        >>> result = gsmerge.compact("demo", effort="draft", budget=300, levels=2)
        >>> [len(level.gaussians) for level in (result, *result.coarser)]
        [300, 75]
    """

    gaussians: Gaussians
    report: CompactReport
    cameras: Cameras
    coarser: tuple[CompactResult, ...] = ()
    names: tuple[str, ...] = ()
    scene: StrPath | ReferenceType[Scene] | None = field(default=None, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"scene": self.scene if isinstance(self.scene, str | PathLike) else None}

    @check_arguments
    def save(self, path: StrPath, *, overwrite: bool = False) -> Path:
        """Write the result with its levels and cameras, as ``-o`` of the command does: all files, or none.

        The name chooses the format: ``.ply``, ``.sog``, ``.spz``, ``.splat``, ``.glb``, ``.usdz``, a page ``.html``,
        levels that stream ``lod-meta.json``, or a folder ``colmap``. Other formats have ``NAME.cameras.json`` beside.

        Args:
            path: The file, or a folder named ``colmap``.
            overwrite: Replace existing files.

        Returns:
            The path of the main file.

        Raises:
            UsageError: If the name has another ending, or the format needs cameras and there are none.
            SceneError: If a file exists or cannot be written.

        Example:
            >>> result = gsmerge.compact("demo", effort="draft", budget=300)
            >>> result.save("demo/small.sog", overwrite=True).name
            'small.sog'
        """
        cameras, levels = self.cameras.numpy(), [level.gaussians for level in (self, *self.coarser)]
        names = self.names or tuple(f"view {view}" for view in range(len(cameras)))
        return write_result(Path(path), levels, cameras, names, self.report.new_views, overwrite=overwrite)

    @check_arguments
    def show(self, scene: Scene | StrPath | None = None) -> Page:
        """Show the scene and the result as :func:`gsmerge.view` does, in a notebook at the end of a cell.

        ``scene``: the input, which only needs to be given where it is in memory no more; without it the result is shown
        alone.
        """
        from gsmerge.pages.view import view

        if scene is None:
            scene = self.scene() if isinstance(self.scene, ReferenceType) else self.scene
        if scene is not None:
            return view(scene, self)
        return view(make_scene(self.gaussians, self.cameras))

    def __repr__(self) -> str:
        levels = f", {len(self.coarser)} coarser level(s)" if self.coarser else ""
        return f"CompactResult({self.gaussians!r}, {self.cameras!r}{levels})"

    def _repr_html_(self) -> str:
        """Show the report and, where cameras are known, a render of the middle view."""
        report = self.report._repr_html_()
        if len(self.cameras) == 0:
            return report
        from gsmerge.measure.preview import picture_html, to_picture

        middle = self.cameras.numpy()[[len(self.cameras) // 2]]
        given = self.scene() if isinstance(self.scene, ReferenceType) else None  # a path is not read again for this
        drawn = (
            {"after": self.gaussians} if given is None else {"before": given.file_gaussians, "after": self.gaussians}
        )
        return (
            "".join(
                picture_html(to_picture(render(each.numpy(), middle).images[0]), f"the middle view {name}")
                for name, each in drawn.items()
            )
            + report
        )

    def to_single(self) -> CompactResult:
        """Return the same result, of arrays, with means as float32 numbers."""
        coarser = tuple(level.to_single() for level in self.coarser)
        return replace(self, gaussians=replace(self.gaussians, means=to_float32(self.gaussians.means)), coarser=coarser)

    def to(self, device: torch.device | str | None) -> CompactResult:
        """Return the same result with tensors on a device; None leaves NumPy arrays."""
        if device is None:
            return self
        coarser = tuple(level.to(device) for level in self.coarser)
        return replace(self, gaussians=self.gaussians.to(device), coarser=coarser)


@dataclass(frozen=True, eq=False)
class Candidate:
    """Gaussians built for one count, with their score."""

    count: int | None  # Gaussians that were asked for; None: as many as `superpixels` and K give
    fitted: Fitted  # Fitted canonical Gaussians
    gaussians: Gaussians  # The same in the world, with those that no view sees
    cameras: Cameras  # The given views as the Gaussians were made from them, in the world
    psnr: float | None  # Mean PSNR (dB) of the scored views, against photos or renders of the input; None without views
    record: Record  # Seconds, choices and notes of building and scoring it
    deciding_psnr: float | None = None  # The same over the pixels that the input covers, where it decides the count


def score(count: int | None, fitted: Fitted, prepared: Prepared, plan: Plan) -> Candidate:
    """Move canonical Gaussians into the world, add Gaussians that no view sees, and measure the PSNR on the photos."""
    gaussians, moved = fitted.gaussians, _move_views(prepared, fitted.cameras)
    if len(plan.unseen):
        gaussians = Gaussians.concat([gaussians, plan.unseen])
    gaussians, cameras = moved.frame.leave(gaussians), moved.input_scene.cameras
    if cameras is not prepared.input_scene.cameras:
        _note_moves(prepared, cameras, plan)
    psnr, kept = _measure_candidate(gaussians, moved, plan)
    return Candidate(count, fitted, gaussians, cameras, psnr, current_record(), kept)


def shrink(candidate: Candidate, gaussians: Gaussians, prepared: Prepared, plan: Plan) -> Candidate:
    """Replace a candidate's Gaussians by a subset, and measure it again."""
    with record_part() as record:
        psnr, _ = _measure_candidate(gaussians, _move_views(prepared, candidate.fitted.cameras), plan)
    choices = candidate.record.choices | record.choices
    return replace(candidate, gaussians=gaussians, psnr=psnr, record=replace(candidate.record, choices=choices))


def _measure_candidate(gaussians: Gaussians, moved: Prepared, plan: Plan) -> tuple[float | None, float | None]:
    """Measure the PSNR (dB) of the scored photos, or of renders of the input, and of pixels that decide the count."""
    if moved.reference.name == RENDERS:
        fidelity = _fidelity(moved.frame.enter(_written(gaussians, plan)), moved, plan)
        views, placed = len(plan.scored_views), moved.reference.placed
        choose(fidelity={"psnr": fidelity, "views": views, "held_out": placed})
        return fidelity, fidelity
    measured = measure_result(gaussians, moved, plan, None if plan.before is None else plan.before.covered)
    if measured is None:
        return None, None
    choose(scored_views=len(plan.scored_views))
    return measured.psnr, measured.psnr if covers_all(plan.before) else measured.covered_psnr


def covers_all(before: PhotoScore | None) -> bool:
    """Return whether an input with this score is compared over whole pictures: it covers all of them, or nothing."""
    return before is None or before.share >= WHOLE or not math.isfinite(before.covered_psnr)


@stage("score")
def _fidelity(gaussians: Gaussians, prepared: Prepared, plan: Plan) -> float:
    """Measure the mean PSNR (dB), at most 120, of canonical Gaussians against renders of the input, where it covers."""
    measured = measure_renders(gaussians, prepared, plan)
    return measured.psnr if plan.covered is None else measured.covered_psnr


def measure_renders(gaussians: Gaussians, prepared: Prepared, plan: Plan) -> PhotoScore:
    """Score canonical Gaussians against renders of the input in the scored views."""
    return score_photos(gaussians, scene_photos(prepared.scene), _rendered_views(prepared, plan), covered=plan.covered)


def may_leave_gaps(prepared: Prepared, plan: Plan) -> bool:
    """Return whether renders of the input are black, as where it covers nothing, in more than a few scored pixels."""
    pictures = (prepared.scene.images[view] for view in _rendered_views(prepared, plan))
    return bool(np.mean([(picture.max(-1) > ROUNDING).mean() for picture in pictures]) < WHOLE)


def _rendered_views(prepared: Prepared, plan: Plan) -> Sequence[int]:
    return [prepared.repeated[view] for view in plan.scored_views] if prepared.repeated else plan.scored_views


def _move_views(prepared: Prepared, cameras: Cameras) -> Prepared:
    """Return the input views with the canonical ``cameras`` of a fit; unchanged if the fit moved none."""
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
    choose(poses=moves)
    note(f"{cause}: cameras were moved by {describe_moves(moves)}")


def measure_result(
    gaussians: Gaussians, prepared: Prepared, plan: Plan, covered: Sequence[np.ndarray] | None = None
) -> PhotoScore | None:
    """Score a result, as its file keeps it, on the scored photos, and over ``covered`` pixels; None without photos."""
    if not prepared.reference.of_views:
        return None
    return _score_photos("score", _written(gaussians, plan), prepared.result_views(), prepared, plan, covered)


def _written(gaussians: Gaussians, plan: Plan) -> Gaussians:
    """Return Gaussians as the file of the output keeps them; as they are where there is none."""
    return as_written(plan.output, gaussians) if plan.output else gaussians


def measure_input(prepared: Prepared, plan: Plan) -> PhotoScore | None:
    """Score the input's own Gaussians, also over the pixels that show any where views have Gaussians of their own."""
    if not prepared.reference.of_views:
        return None
    scene, shown = prepared.input_scene, prepared.scene
    if shown.empty is not None:  # where a result may show nothing, the input is not compared either
        scene = replace(scene, masks=prepared.result_views().masks)
    covered = None if scene.covered is None else list(scene.covered[list(plan.scored_views)])
    return _score_photos("input", scene.file_gaussians, scene, prepared, plan, covered)


def _score_photos(
    name: str, gaussians: Gaussians, views: Scene, prepared: Prepared, plan: Plan, covered: Sequence[np.ndarray] | None
) -> PhotoScore:
    """Score Gaussians in the stage ``name`` on the scored photos: a quarter of each, or all if a quality is sought."""
    with stage(name):
        near, quarter = NEAR_PLANE * prepared.frame.unit, plan.target_psnr is None and not plan.keeps_fidelity
        photos = scene_photos(views)
        return score_photos(gaussians, photos, plan.scored_views, quarter=quarter, near=near, covered=covered)


def measure_covered(before: PhotoScore | None, gaussians: Gaussians, prepared: Prepared, plan: Plan) -> Covered | None:
    """Score a result over the pixels that the input covers, whose score is ``before``; None if it covers all."""
    if before is None or covers_all(before) or prepared.scene.empty is not None:  # whose photos count where it covers
        return None
    after = measure_result(gaussians, prepared, plan, before.covered)
    return None if after is None else Covered(before.share, before.covered_psnr, after.covered_psnr)


def measure_on_files(gaussians: Gaussians, prepared: Prepared, plan: Plan) -> float | None:
    """Score Gaussians of the world on photos as their files have them; None where no scored one was changed."""
    files = prepared.reference.photo_files
    if files is None:
        return None
    shown = prepared.result_views()
    if shown.images is None or all(np.array_equal(shown.images[view], files[view]) for view in plan.scored_views):
        return None
    views = replace(shown, images=files)
    return _score_photos("score", gaussians, views, prepared, plan, None).psnr


def measure_protected(gaussians: Gaussians, prepared: Prepared, plan: Plan) -> PhotoScore | None:
    """Score Gaussians of the world over the protected pixels, in views that have some; None where none has.

    The share is that of all photos.
    """
    if not prepared.reference.of_views or prepared.input_scene.protected is None:
        return None
    with stage("score"):
        shown = prepared.result_views()
        assert shown.protected is not None
        have = np.flatnonzero(shown.protected.any((1, 2))).tolist()
        views = [have[i] for i in scored_views(len(have))]
        near, masks = NEAR_PLANE * prepared.frame.unit, list(shown.protected[views])
        score = score_photos(gaussians, scene_photos(shown), views, near=near, covered=masks)
        return replace(score, share=float(shown.protected.mean()))


@dataclass(frozen=True)
class InputScores:
    """Scores of an input, which a result is compared with; None in place of each that cannot be measured."""

    photos: PhotoScore | None  # on the scored views
    on_files: float | None  # on the files of photos that were changed, dB
    protected: PhotoScore | None  # over protected pixels


def score_input(prepared: Prepared, plan: Plan) -> InputScores:
    """Score the input's own Gaussians, unless the plan has that."""
    photos, gaussians = plan.before or measure_input(prepared, plan), prepared.input_scene.file_gaussians
    return InputScores(
        photos, measure_on_files(gaussians, prepared, plan), measure_protected(gaussians, prepared, plan)
    )


@dataclass(frozen=True)
class Besides:
    """PSNR of a result on parts of the pixels, or on other photos; None in place of each that says nothing more."""

    covered: Covered | None = None
    photo_files: PhotoFiles | None = None
    protected: Covered | None = None


def measure_besides(before: InputScores, gaussians: Gaussians, prepared: Prepared, plan: Plan) -> Besides:
    """Score a result over pixels that the input covers or that are protected, and on photos as their files have them.

    The scores of the input come ``before``.
    """
    covered, written = measure_covered(before.photos, gaussians, prepared, plan), _written(gaussians, plan)
    after = None if before.on_files is None else measure_on_files(written, prepared, plan)
    files = None if before.on_files is None or after is None else PhotoFiles(before.on_files, after)
    within = None if before.protected is None else measure_protected(written, prepared, plan)
    if before.protected is None or within is None:
        return Besides(covered, files)
    return Besides(covered, files, Covered(within.share, before.protected.covered_psnr, within.covered_psnr))


def make_result(
    best: Candidate,
    levels: Sequence[Candidate],
    prepared: Prepared,
    plan: Plan,
    search: Mapping[str, Any],
    trial: Trial | None = None,
) -> CompactResult:
    """Make the result from the best candidate and its coarser levels of detail, with a report.

    ``search`` are the facts of :meth:`gsmerge.compaction.search.CountSearch.facts`. The input is scored last, when
    memory is free again, unless the plan has its score. The report contains the seconds, choices and notes of the
    current record, followed by those of the candidates.
    """
    run, seconds = current_record(), search["seconds"]
    input_scores = score_input(prepared, plan)
    before = None if input_scores.photos is None else input_scores.photos.psnr
    measured = [
        measure_besides(input_scores, candidate.gaussians, _move_views(prepared, candidate.fitted.cameras), plan)
        for candidate in (best, *levels)
    ]
    names = {**run.seconds, **seconds}
    seconds = {name: run.seconds.get(name, 0.0) + seconds.get(name, 0.0) for name in names}
    if "input" in seconds:
        seconds["input"] = seconds.pop("input")  # the last stage, after those of the candidates
    main = _report(best, prepared, plan, before, measured[0], seconds, 0)
    choices, notes = run.choices | main.choices | search["choices"], [*run.notes, *search["notes"], *main.notes]
    new_views, worse = _expect_new_views(main, prepared, trial)
    if worse is not None:
        main, notes = replace(main, worse=worse), [*notes, worse]
    main = replace(main, choices=choices, notes=notes, unmet=search["unmet"], new_views=new_views)
    coarser = tuple(
        CompactResult(
            candidate.gaussians,
            _report(candidate, prepared, plan, before, measured[level], candidate.record.seconds, level),
            candidate.cameras,
        )
        for level, candidate in enumerate(levels, 1)
    )
    return CompactResult(best.gaussians, main, best.cameras, coarser)


def _report(
    candidate: Candidate,
    prepared: Prepared,
    plan: Plan,
    before: float | None,
    besides: Besides,
    seconds: Mapping[str, float],
    level: int,
) -> CompactReport:
    """Report on one level of detail, given the PSNR of the input ``before``; 0 is the result itself."""
    reference, record, covered = prepared.reference, candidate.record, besides.covered
    rendered = reference.name == RENDERS
    shown = None if rendered else candidate.psnr
    made = CompactReport(
        prepared.input_scene.num_gaussians, len(candidate.gaussians), dict(seconds), before, shown, record.choices,
        record.notes, plan.settings, peak_memory(), psnr_reference=None if before is None else reference.name,
        **vars(besides),
    )  # fmt: skip
    if prepared.doubt is not None:
        choices = {key: value for key, value in record.choices.items() if key != "fidelity"}
        made = replace(made, psnr_before=None, psnr_after=None, **vars(Besides()), choices=choices)
        return replace(made, notes=[*made.notes, prepared.doubt], worse=prepared.doubt)
    worse = None
    if rendered and level == 0 and not plan.clean.visible_drops:  # coarser levels are meant to differ
        worse = describe_distance(candidate.psnr)
    elif reference.of_views and not plan.clean.visible_drops:
        name, pictures = f"level {level}" if level else "the result", reference.name
        compared = (covered.before, covered.after) if covered else (before, shown)
        worse = describe_loss(name, *compared, OWN_PHOTOS if pictures == PHOTOS else pictures)
    return made if worse is None else replace(made, notes=[*made.notes, worse], worse=worse)


def _expect_new_views(
    main: CompactReport, prepared: Prepared, trial: Trial | None
) -> tuple[NewViews | None, str | None]:
    """Predict new views by a trial; also say so where a result that is not said to be worse makes them worse."""
    before, after = (main.covered.before, main.covered.after) if main.covered else (main.psnr_before, main.psnr_after)
    if trial is None or prepared.agreement is None or before is None or after is None:
        return None, None
    expected = trial.predict(before, after, prepared.agreement.confirmed)
    is_large = max(prepared.scene.cameras.width, prepared.scene.cameras.height) >= SIDE  # smaller pictures say little
    if not is_large or main.worse is not None or expected.high >= 0:
        return expected, None
    return expected, f"new views of the result are expected to be {-expected.gain:.1f} dB worse than those of the input"
