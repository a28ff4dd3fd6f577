"""Scores of all blocks -> the report of the whole scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np

from gsmerge.compaction.block_start import BlockStart
from gsmerge.compaction.report import CompactReport, Covered, PhotoFiles, compared_psnr
from gsmerge.compaction.scores import PartScores
from gsmerge.facts.row_colors import OWN_PHOTOS, PHOTOS
from gsmerge.raster.metrics import describe_loss
from gsmerge.runtime.memory import peak_memory
from gsmerge.runtime.record import current_record
from gsmerge.settings.compact import CompactOptions
from gsmerge.types import Gaussians, Scene


@dataclass(frozen=True)
class BlockScores:
    """Scores of the whole result on the photos of one block."""

    psnr: float | None  # On the scored photos, dB; None without photos
    parts: PartScores


def join_reports(
    scene: Scene,
    gaussians: Gaussians,
    starts: Sequence[BlockStart],
    scores: Sequence[BlockScores],
    options: CompactOptions,
) -> CompactReport:
    """Report on the whole scene: mean PSNR of the blocks weighted by views, sums of seconds, all notes."""
    run, sizes = current_record(), [len(start.block.own) for start in starts]

    def mean(values: Sequence[float | None]) -> float | None:
        numbers = [value for value in values if value is not None]
        return None if len(numbers) < len(values) else float(np.average(numbers, weights=sizes))

    num_scored = sum(
        len(start.plan.scored_views) for start, score in zip(starts, scores, strict=True) if score.psnr is not None
    )
    before = mean([None if start.before.photos is None else start.before.photos.psnr for start in starts])
    after = mean([score.psnr for score in scores])
    parts = _join_parts(starts, scores, sizes)
    reference = None if before is None else starts[0].prepared.reference.name
    pictures = OWN_PHOTOS if reference == PHOTOS else reference
    worse = None
    if pictures is not None:
        worse = describe_loss("the result", *compared_psnr(parts.covered, before, after), pictures)
    notes = list(dict.fromkeys(run.notes))
    return CompactReport(
        num_input=scene.num_gaussians, num_output=len(gaussians), seconds=dict(run.seconds), psnr_before=before,
        psnr_after=after, choices=run.choices | {"scored_views": num_scored},
        notes=notes if worse is None else [*notes, worse], options=options.to_dict(),
        peak_memory_bytes=peak_memory(), worse=worse, psnr_reference=reference, **vars(parts),
    )  # fmt: skip


def _join_parts(starts: Sequence[BlockStart], scores: Sequence[BlockScores], sizes: Sequence[int]) -> PartScores:
    """Average the blocks' scores on parts of the pixels, weighted by ``sizes``, the numbers of views.

    A block without a score of covered pixels, or on photo files, counts with its score on all pixels. The mean is None
    if no block has one, or if some block has no score at all. Scores of protected pixels are averaged over the blocks
    that have such pixels, weighted by their number.
    """
    whole = [
        (start.before.photos.psnr, score.psnr)
        for start, score in zip(starts, scores, strict=True)
        if start.before.photos is not None and score.psnr is not None
    ]
    if len(whole) < len(sizes):
        return PartScores()

    def mean(rows: Sequence[tuple[float, ...]], weights: Sequence[float] = sizes) -> list[float]:
        return np.average(rows, axis=0, weights=weights).tolist()

    block_parts = [score.parts for score in scores]
    covered = photo_files = protected = None
    if any(parts.covered for parts in block_parts):
        rows = [astuple(parts.covered or Covered(1.0, *pair)) for parts, pair in zip(block_parts, whole, strict=True)]
        covered = Covered(*mean(rows))
    if any(parts.photo_files for parts in block_parts):
        rows = [astuple(parts.photo_files or PhotoFiles(*pair)) for parts, pair in zip(block_parts, whole, strict=True)]
        photo_files = PhotoFiles(*mean(rows))
    protected_shares = [parts.protected.share if parts.protected else 0.0 for parts in block_parts]
    shares = [size * share for size, share in zip(sizes, protected_shares, strict=True)]
    if sum(shares) > 0:
        rows = [
            (parts.protected.before, parts.protected.after) if parts.protected else (0.0, 0.0) for parts in block_parts
        ]
        protected = Covered(sum(shares) / sum(sizes), *mean(rows, shares))
    return PartScores(covered, photo_files, protected)
