"""Make the report of a whole scene from the scores of all its blocks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmerge.errors import Doubt
from gsmerge.prepare.row_colors import OWN_PHOTOS, PHOTOS
from gsmerge.raster.metrics import SAMPLE_LOSS, describe_loss, is_worse
from gsmerge.results.report import CompactReport
from gsmerge.runtime.memory import peak_memory
from gsmerge.runtime.record import current_record
from gsmerge.scoring.evaluate import evaluate
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.evaluate import EvaluateOptions
from gsmerge.special.blocks.start_block import BlockStart
from gsmerge.types import Gaussians, Scene


def join_reports(
    scene: Scene,
    gaussians: Gaussians,
    starts: Sequence[BlockStart],
    psnrs: Sequence[float | None],
    options: CompactOptions,
) -> CompactReport:
    """Make the report of the whole scene. Its PSNR is the mean of the blocks' PSNR, weighted by their numbers of views.

    ``psnrs`` has the PSNR (dB) of the result on the photos of each block, or None without photos. Seconds and notes
    come from the current record. If the result may be worse than the input, result and input are scored again on all
    photos.
    """
    run, num_views = current_record(), [len(start.block.own) for start in starts]

    def mean(values: Sequence[float | None]) -> float | None:
        """Average a value of each block, weighted by the blocks' numbers of views; None if a block has no value."""
        numbers = [value for value in values if value is not None]
        return None if len(numbers) < len(values) else float(np.average(numbers, weights=num_views))

    scored = sum(len(start.plan.scored_views) for start, psnr in zip(starts, psnrs, strict=True) if psnr is not None)
    before, after = mean([start.psnr_before for start in starts]), mean(psnrs)
    reference = None if before is None else starts[0].prepared.reference.name
    pictures = OWN_PHOTOS if reference == PHOTOS else reference
    may_be_worse = reference == PHOTOS and is_worse(before, after, SAMPLE_LOSS)
    if may_be_worse:
        exact = evaluate(scene, {"result": gaussians}, options=EvaluateOptions(lpips=(), fog=False))
        before, after = (scores.mean("context")[scene.masks is not None].psnr for scores in exact.results)
    worse = None if pictures is None else describe_loss("the result", before, after, pictures)
    return CompactReport(
        num_input=scene.num_gaussians, num_output=len(gaussians), seconds=dict(run.seconds), psnr_before=before,
        psnr_after=after, notes=[*run.notes, *([] if worse is None else [Doubt(worse, "worse")])],
        choices=run.choices | {"scored_views": len(scene) if may_be_worse else scored, "scored_all": may_be_worse},
        options=options.to_dict(), peak_memory_bytes=peak_memory(), worse=worse, psnr_reference=reference,
    )  # fmt: skip
