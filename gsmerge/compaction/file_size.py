"""Meet a size in bytes in formats whose files do not have so many bytes for each Gaussian."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from gsmerge.compaction.candidate import Candidate, shrink
from gsmerge.compaction.search import meet
from gsmerge.errors import UsageError
from gsmerge.facts.prepare import Prepared
from gsmerge.io.formats.arrays import MIP_COMMENT, RESULT_COMMENT
from gsmerge.io.formats.table import Format
from gsmerge.plan import Plan
from gsmerge.runtime.memory import human_bytes
from gsmerge.stages.clean import faintest_dropped
from gsmerge.types import Cameras, Gaussians

NEAR_SHARE, MOST_DROPPED = 0.97, 0.08  # share of the size that is reached; of the Gaussians that are left out, at most
ENOUGH = 0.985  # share of the size from which on no further one is put back
SURPLUS = 1.02  # times the Gaussians that the size seems to have room for
TRIES, MAX_REBUILDS = 8, 2

Rebuild = Callable[[int | None], Candidate]  # a count -> a candidate of all views, built, cleaned up and scored


def measure_bytes(gaussians: Gaussians, file: Format, cameras: Cameras) -> int:
    """Count the bytes of a file with the given Gaussians; of a page, which shows ``cameras``, at most."""
    comments = RESULT_COMMENT, MIP_COMMENT
    if file.measure is not None:
        return file.measure(gaussians, cameras, comments)
    assert file.encode is not None  # others have a count for each size
    return len(file.encode(gaussians, comments))


def meet_bytes(candidate: Candidate, rebuild: Rebuild, prepared: Prepared, plan: Plan) -> Candidate:
    """Make a candidate as large as its file may be: rebuild it until it is near, then drop its faintest Gaussians."""
    if plan.size is None or not plan.size.packed:
        return candidate
    most, file = plan.size.num_bytes, plan.size.file
    rest = measure_rest(candidate.gaussians, most, file, candidate.cameras)

    def choose_next(built: Sequence[Candidate]) -> int | None:
        size, count = measure_bytes(built[-1].gaussians, file, built[-1].cameras), len(built[-1].gaussians)
        asked = max(count, built[-1].count or 0)  # what nobody sees is left out, and its bytes are not filled up
        whole = rest + (size - rest) * asked / max(count, 1)
        room = min(int(SURPLUS * count * (most - rest) / max(size - rest, 1)), plan.limits.most)
        fits = room >= (1 - MOST_DROPPED) * count and (whole >= NEAR_SHARE * most or room <= SURPLUS * asked)
        return None if fits or len(built) > MAX_REBUILDS else room

    candidate = meet(rebuild, candidate, choose_next)[-1]
    kept = drop_to_bytes(candidate.gaussians, most, file, candidate.cameras, rest)
    return candidate if len(kept) == len(candidate.gaussians) else shrink(candidate, kept, prepared, plan)


def measure_rest(gaussians: Gaussians, most: int, file: Format, cameras: Cameras) -> int:
    """Count the bytes of a file with one of the Gaussians; UsageError if they are more than ``most``."""
    rest = measure_bytes(gaussians[:1], file, cameras)
    if rest > most:
        problem = f"expected at least {human_bytes(rest)} for a {file.ending} with one Gaussian"
        raise UsageError(f"budget: {problem}, got {human_bytes(most)}")
    return rest


def drop_to_bytes(gaussians: Gaussians, most: int, file: Format, cameras: Cameras, rest: int) -> Gaussians:
    """Keep as many of the largest and most opaque Gaussians as fit into ``most`` bytes; one takes ``rest``."""
    low, high = 0, len(gaussians)
    kept, count = gaussians[:0], len(gaussians)
    for _ in range(TRIES):
        tried = gaussians if count == len(gaussians) else faintest_dropped(gaussians, count)
        size = measure_bytes(tried, file, cameras)
        if size <= most:
            low, kept = count, tried
        else:
            high = count - 1
        if low == len(gaussians) or (low and ENOUGH * most <= size <= most) or low >= high:
            break
        count = min(max(low + 1, int(count * ((1 + ENOUGH) / 2 * most - rest) / max(size - rest, 1))), high)
    return kept
