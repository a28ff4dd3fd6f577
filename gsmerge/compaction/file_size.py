"""Meet a size in bytes in formats whose files do not have so many bytes for each Gaussian."""

from __future__ import annotations

from collections.abc import Callable

from gsmerge.compaction.result import Candidate, shrink
from gsmerge.facts.prepare import Prepared
from gsmerge.io.formats.arrays import MIP_COMMENT, RESULT_COMMENT
from gsmerge.io.formats.ply import file_bytes
from gsmerge.io.formats.table import Format
from gsmerge.plan import Plan
from gsmerge.stages.clean import faintest_dropped
from gsmerge.types import Gaussians

NEAR, MOST_DROPPED = 0.97, 0.08  # share of the size that is reached; of the Gaussians that are left out, at most
ENOUGH = 0.985  # share of the size from which on no further one is put back
SURPLUS = 1.02  # times the Gaussians that the size seems to have room for
TRIES, MAX_REBUILDS = 8, 3

Rebuild = Callable[[int], Candidate]


def measure_bytes(gaussians: Gaussians, file: Format) -> int:
    """Count the bytes of a file with the given Gaussians."""
    if file.encode is None:
        return file_bytes(len(gaussians), gaussians.sh_degree)
    return len(file.encode(gaussians, (RESULT_COMMENT, MIP_COMMENT)))


def meet_bytes(candidate: Candidate, rebuild: Rebuild, prepared: Prepared, plan: Plan) -> Candidate:
    """Make a candidate as large as its file may be: rebuild it until it is near, then drop its faintest Gaussians."""
    if plan.size is None or not plan.size.packed:
        return candidate
    most, file = plan.size.num_bytes, plan.size.file
    for _ in range(MAX_REBUILDS):
        size, count = measure_bytes(candidate.gaussians, file), len(candidate.gaussians)
        room = min(int(SURPLUS * count * most / size), plan.limits.most)
        if room >= (1 - MOST_DROPPED) * count and (size >= NEAR * most or room <= count):
            break
        candidate = rebuild(room)
    kept = drop_to_bytes(candidate.gaussians, most, file)
    return candidate if len(kept) == len(candidate.gaussians) else shrink(candidate, kept, prepared, plan)


def drop_to_bytes(gaussians: Gaussians, most: int, file: Format) -> Gaussians:
    """Keep as many of the largest and most opaque Gaussians as fit into ``most`` bytes; this may be none."""
    low, high = 0, len(gaussians)
    kept, count = gaussians[:0], len(gaussians)
    for _ in range(TRIES):
        tried = gaussians if count == len(gaussians) else faintest_dropped(gaussians, count)
        size = measure_bytes(tried, file)
        if size <= most:
            low, kept = count, tried
        else:
            high = count - 1
        if low == len(gaussians) or (low and ENOUGH * most <= size <= most) or low >= high:
            break
        count = min(max(low + 1, int((1 + ENOUGH) / 2 * count * most / size)), high)
    return kept
