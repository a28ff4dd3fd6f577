"""Meet a size in bytes in formats whose files do not have so many bytes for each Gaussian."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from gsmerge.budget import LEVEL_FACTOR, FileSize
from gsmerge.compaction.result import Candidate, shrink
from gsmerge.facts.prepare import Prepared
from gsmerge.io.formats.arrays import MIP_COMMENT, RESULT_COMMENT
from gsmerge.io.formats.ply import file_bytes
from gsmerge.io.formats.streamed import streamed_files
from gsmerge.io.formats.table import PLY, Format
from gsmerge.plan import Plan
from gsmerge.stages.clean import faintest_dropped
from gsmerge.types import Gaussians

NEAR, MOST_DROPPED = 0.97, 0.08  # share of the size that is reached; of the Gaussians that are left out, at most
ENOUGH = 0.985  # share of the size from which on no further one is put back
SURPLUS = 1.02  # times the Gaussians that the size seems to have room for
TRIES, MAX_REBUILDS = 8, 3

Rebuild = Callable[[int], Candidate]


def measure_bytes(levels: Sequence[Gaussians], file: Format, environment: Gaussians | None = None) -> int:
    """Count the bytes of a file with the given Gaussians; for an index with several levels, an upper bound."""
    first = levels[0]
    if file is PLY:
        return file_bytes(len(first), first.sh_degree)
    if file.encode is None:
        longest = 1.234e-5  # as long as an error can be
        files = streamed_files(
            levels, environment=environment, measure=lambda leaves: np.full((len(leaves), len(levels)), longest)
        )
        return sum(map(len, files.values()))
    return len(file.encode(first, (RESULT_COMMENT, MIP_COMMENT)))


def meet_bytes(candidate: Candidate, rebuild: Rebuild, prepared: Prepared, plan: Plan) -> Candidate:
    """Make a candidate as large as its file may be: rebuild it until it is near, then drop its faintest Gaussians.

    For an index of levels, a sample of the Gaussians stands for the coarser levels; see :func:`meet_bytes_of_levels`.
    """
    if plan.size is None or not plan.size.packed:
        return candidate
    most = plan.size.num_bytes
    for _ in range(MAX_REBUILDS):
        gaussians = candidate.gaussians
        size, count = measure_bytes(_with_coarser(gaussians, plan.size), plan.size.file), len(gaussians)
        room = min(int(SURPLUS * count * most / size), prepared.input_scene.num_gaussians)
        if room >= (1 - MOST_DROPPED) * count and (size >= NEAR * most or room <= count):
            break
        candidate = rebuild(room)
    coarser = _with_coarser(candidate.gaussians, plan.size)[1:]
    return _without_faintest(candidate, coarser, prepared, plan)


def meet_bytes_of_levels(
    candidate: Candidate, coarser: Sequence[Candidate], rebuild: Rebuild, prepared: Prepared, plan: Plan
) -> Candidate:
    """Make the finest level as large as the bytes that the coarser levels of an index leave.

    It is rebuilt if the coarser levels are smaller than expected, and otherwise loses its faintest Gaussians.
    """
    if plan.size is None or plan.size.levels == 1:
        return candidate
    levels, most = [level.gaussians for level in coarser], plan.size.num_bytes
    for _ in range(MAX_REBUILDS):
        count, size = len(candidate.gaussians), measure_bytes([candidate.gaussians, *levels], plan.size.file)
        if size >= NEAR * most or count == prepared.input_scene.num_gaussians:
            break
        more = math.ceil(SURPLUS * sum(map(len, (candidate.gaussians, *levels))) * (most - size) / size)
        candidate = rebuild(min(count + more, prepared.input_scene.num_gaussians))
    return _without_faintest(candidate, levels, prepared, plan)


def _with_coarser(gaussians: Gaussians, size: FileSize) -> list[Gaussians]:
    """Return the Gaussians, and samples of them that stand for the coarser levels of the file."""
    return [faintest_dropped(gaussians, len(gaussians) // LEVEL_FACTOR**level) for level in range(size.levels)]


def drop_to_bytes(gaussians: Gaussians, coarser: Sequence[Gaussians], most: int, file: Format) -> Gaussians:
    """Keep as many of the largest and most opaque Gaussians as fit into ``most`` bytes; this may be none."""
    low, high = 0, len(gaussians)
    kept, count = gaussians[:0], len(gaussians)
    for _ in range(TRIES):
        tried = gaussians if count == len(gaussians) else faintest_dropped(gaussians, count)
        size = measure_bytes([tried, *coarser], file)
        if size <= most:
            low, kept = count, tried
        else:
            high = count - 1
        if low == len(gaussians) or (low and ENOUGH * most <= size <= most) or low >= high:
            break
        count = min(max(low + 1, int((1 + ENOUGH) / 2 * count * most / size)), high)
    return kept


def _without_faintest(candidate: Candidate, coarser: Sequence[Gaussians], prepared: Prepared, plan: Plan) -> Candidate:
    assert plan.size is not None
    kept = drop_to_bytes(candidate.gaussians, coarser, plan.size.num_bytes, plan.size.file)
    return candidate if len(kept) == len(candidate.gaussians) else shrink(candidate, kept, prepared, plan)
