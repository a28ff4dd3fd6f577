"""Candidates -> result: the Gaussians, their coarser levels of detail, and the report of the run."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any
from weakref import ReferenceType, ref

import numpy as np

from gsmerge.arrays import to_float32
from gsmerge.errors import DoubtWarning, count_words
from gsmerge.frozen import dataclass, field, replace
from gsmerge.io.formats.rows import result_comments
from gsmerge.io.formats.table import Contents
from gsmerge.method.facts.pictures import OWN_PHOTOS, PHOTOS, RENDERS
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.pipelines.plan import Plan
from gsmerge.method.raster.metrics import SAMPLE_LOSS, describe_distance, describe_loss, is_worse
from gsmerge.plan.make_plan import pictured_views
from gsmerge.results.candidate import Candidate, rescore, with_moved_views
from gsmerge.results.distance import describe_clear_loss, is_clearly_worse
from gsmerge.results.lost_values import describe_lost_values
from gsmerge.results.outputs import NUM_FULL, name_outputs, pad_harmonics, write_outputs
from gsmerge.results.report import CompactReport, compared_psnr
from gsmerge.results.scores import PartScores, measure_parts, score_input
from gsmerge.runtime.arguments import check_arguments
from gsmerge.runtime.memory import peak_memory
from gsmerge.types import Cameras, Gaussians, Scene, StrPath, make_scene, number_views

if TYPE_CHECKING:
    import torch

    from gsmerge.drawing.pages.view import Page


@dataclass(frozen=True)
class CompactResult:
    """The compact Gaussians, in the world frame of the scene, and the report.

    Args:
        gaussians: The Gaussians.
        report: The report of the run.
        cameras: The cameras of the input's views, in the frame of the Gaussians. Wrong poses have been corrected, see
            ``poses`` of :class:`gsmerge.settings.stages.PrepareOptions`.
        coarser: Coarser levels of detail; each has a quarter of the Gaussians of the level before.
        names: Names of the views.
        scene: The path of the scene or, for a scene in memory, a weak reference, which does not keep it in memory.

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
        """Write the result with its levels and cameras, as ``-o`` of the command does: all files or none.

        The name chooses the format: ``.ply``, ``.sog``, ``.spz``, ``.splat``, ``.glb``, ``.html`` for a
        page, or ``lod-meta.json`` for levels that stream. A format without cameras gets
        ``NAME.cameras.json`` beside its file.

        Args:
            path: The file.
            overwrite: Replace existing files.

        Returns:
            The path.

        Raises:
            UsageError: If the name has another ending.
            SceneError: If a file exists or cannot be written.

        Example:
            >>> result = gsmerge.compact("demo", effort="draft", budget=300)
            >>> result.save("demo/small.sog", overwrite=True).name
            'small.sog'
        """
        cameras = self.cameras.numpy()
        levels = [level.gaussians.numpy() for level in (self, *self.coarser)]
        outputs = name_outputs(Path(path), overwrite=overwrite)
        names = self.names or number_views(len(cameras))
        comments = result_comments(self.report.new_views)
        write_outputs(outputs, Contents(levels, comments, cameras, names, outputs.result.stem))
        for text in describe_lost_values(outputs.result, levels[0], cameras):
            warnings.warn(text, DoubtWarning, stacklevel=3)  # the caller: above this method and its decorator
        return outputs.result

    @check_arguments
    def show(self, scene: Scene | StrPath | None = None) -> Page:
        """Show the scene and the result as :func:`gsmerge.view` does, in a notebook at the end of a cell.

        ``scene`` is the input, and is only needed if the input is no longer in memory. Without an input the result is
        shown alone.
        """
        from gsmerge.drawing.pages.view import view

        if scene is None:
            scene = self.scene() if isinstance(self.scene, ReferenceType) else self.scene
        if scene is not None:
            return view(scene, self)
        return view(make_scene(self.gaussians, self.cameras))

    def __repr__(self) -> str:
        levels = f", {count_words(len(self.coarser), 'coarser level')}" if self.coarser else ""
        return f"CompactResult({self.gaussians!r}, {self.cameras!r}{levels})"

    def to_single(self) -> CompactResult:
        """Return the same result with float32 means; the Gaussians have to be NumPy arrays, not tensors."""
        coarser = tuple(level.to_single() for level in self.coarser)
        return replace(self, gaussians=replace(self.gaussians, means=to_float32(self.gaussians.means)), coarser=coarser)

    def pad_to_full(self) -> CompactResult:
        """Return the same result with harmonics of degree 3, padded with zeros."""
        coarser = tuple(level.pad_to_full() for level in self.coarser)
        return replace(self, gaussians=pad_harmonics(self.gaussians, NUM_FULL), coarser=coarser)

    def for_scene(self, scene: Scene) -> CompactResult:
        """Return the result of a scene in memory: with arrays of the scene's kind, and a weak reference to it."""
        result = self.to(scene.gaussians.device)
        means = scene.gaussians.means
        if isinstance(means, np.ndarray) and means.dtype == np.float32:
            result = result.to_single()
        return replace(result, scene=ref(scene), names=scene.names)

    def to(self, device: torch.device | str | None) -> CompactResult:
        """Return the same result with tensors on a device, or unchanged if the device is None."""
        if device is None:
            return self
        coarser = tuple(level.to(device) for level in self.coarser)
        return replace(self, gaussians=self.gaussians.to(device), coarser=coarser)


def make_result(best: Candidate, levels: Sequence[Candidate], prepared: Prepared, plan: Plan) -> CompactResult:
    """Make the result from the best candidate and its coarser levels of detail, with a report.

    The input is scored here, when memory is free again, unless the plan has its score. Scores may come from a sample of
    the photos. If a sample shows that a result may be worse than the input, this function starts again with all photos.
    The report contains the seconds, choices and notes of the current record, and those of a level its own.
    """
    input_scores = score_input(prepared, plan.score)
    candidates = (best, *levels)
    before = None if input_scores.photos is None else input_scores.photos.psnr
    part_scores = [
        measure_parts(
            input_scores, candidate.gaussians, with_moved_views(prepared, candidate.fitted.cameras), plan.score
        )
        for candidate in candidates
    ]
    if plan.score.samples and any(
        is_worse(*compared_psnr(parts.covered, before, candidate.psnr), SAMPLE_LOSS)
        for parts, candidate in zip(part_scores, candidates, strict=True)
    ):
        plan = replace(plan, score=replace(plan.score, views=pictured_views(prepared), samples=False))
        best, *levels = (rescore(candidate, candidate.gaussians, prepared, plan) for candidate in candidates)
        return make_result(best, levels, prepared, plan)
    seconds = dict(best.record.seconds)
    if "input" in seconds:
        seconds["input"] = seconds.pop("input")  # moved to the end, since the input is scored last
    report = _report(best, prepared, plan=plan, before=before, parts=part_scores[0], seconds=seconds, level=0)
    report = replace(report, unmet=best.unmet)
    coarser = tuple(
        CompactResult(
            candidate.gaussians,
            _report(
                candidate,
                prepared,
                plan=plan,
                before=before,
                parts=part_scores[level],
                seconds=candidate.record.seconds,
                level=level,
            ),
            candidate.cameras,
        )
        for level, candidate in enumerate(levels, 1)
    )
    return CompactResult(best.gaussians, report, best.cameras, coarser)


def _report(
    candidate: Candidate,
    prepared: Prepared,
    plan: Plan,
    before: float | None,
    parts: PartScores,
    seconds: Mapping[str, float],
    level: int,
) -> CompactReport:
    """Return the report of one level of detail; level 0 is the result itself.

    ``before`` is the PSNR (dB) of the input. The report says whether the level is worse than the input.
    """
    reference = prepared.reference
    record = candidate.record
    rendered = reference.name == RENDERS
    after = None if rendered else candidate.psnr
    report = CompactReport(
        prepared.input_scene.num_gaussians, num_output=len(candidate.gaussians), seconds=dict(seconds),
        psnr_before=before, psnr_after=after, choices=record.choices, notes=record.notes, options=plan.settings,
        peak_memory_bytes=peak_memory(), psnr_reference=None if before is None else reference.name, **vars(parts),
    )  # fmt: skip
    if prepared.doubt is not None:  # the photos do not fit the scene, so the report has no scores
        choices = {key: value for key, value in record.choices.items() if key != "fidelity"}
        report = replace(report, psnr_before=None, psnr_after=None, **vars(PartScores()), choices=choices)
        return report.with_worse(prepared.doubt)
    worse = None
    if rendered and level == 0 and not plan.clean.visible_drops:  # coarser levels are meant to differ
        worse = describe_distance(candidate.psnr)
    elif reference.of_views and not plan.clean.visible_drops:
        name = f"level {level}" if level else "the result"
        pictures = reference.name
        compared = compared_psnr(parts.covered, before, after)
        clear_loss = describe_clear_loss(candidate.fitted.gaussians, prepared) if level == 0 else None
        report = replace(report, is_far=clear_loss is not None or is_clearly_worse(*compared))
        worse = describe_loss(name, *compared, OWN_PHOTOS if pictures == PHOTOS else pictures) or clear_loss
    return report if worse is None else report.with_worse(worse)
