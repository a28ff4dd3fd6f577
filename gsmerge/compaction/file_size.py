"""Meet a size in bytes in formats whose number of bytes depends on the content of the file."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from gsmerge.compaction.candidate import Candidate, rescore
from gsmerge.compaction.search import build_in_turn
from gsmerge.errors import UsageError
from gsmerge.facts.prepare import Prepared
from gsmerge.io.formats.arrays import MIP_COMMENT, RESULT_COMMENT
from gsmerge.io.formats.table import Contents, Format
from gsmerge.plan import Plan
from gsmerge.runtime.memory import human_bytes
from gsmerge.stages.clean import faintest_dropped
from gsmerge.types import Cameras, Gaussians

BUILD_SURPLUS = 1.02  # Gaussians of a build, relative to the number that seems to fit
MOST_MEASURED = 8  # most files that are measured to choose how many Gaussians are dropped
MAX_REBUILDS = 2  # most builds after the first one

Rebuild = Callable[[int | None], Candidate]  # build a count of Gaussians from all views, clean up and score them


def measure_bytes(gaussians: Gaussians, file: Format, cameras: Cameras, names: Sequence[str] = ()) -> int:
    """Return the number of bytes of a file with these Gaussians and cameras; of a page, an upper bound of it."""
    comments = RESULT_COMMENT, MIP_COMMENT
    if file.measure is not None:
        return file.measure(gaussians, cameras, comments)
    if file.encode_contents is not None:
        contents = Contents([gaussians], comments, cameras if names else cameras[:0], names)
        placed_bytes = 700  # most bytes of the camera that is written if the scene has none
        return len(file.encode_contents(gaussians, contents)) + placed_bytes * (file.first_view and not names)
    assert file.encode is not None  # all other formats have a fixed number of bytes for each Gaussian
    return len(file.encode(gaussians, comments))


def meet_bytes(candidate: Candidate, rebuild: Rebuild, prepared: Prepared, plan: Plan) -> Candidate:
    """Make the file of a candidate nearly as large as a budget in bytes allows.

    The candidate is rebuilt with other counts until its file is about that large. Then the faintest Gaussians are
    dropped until it fits. Without such a budget, or if the bytes follow from the count, the candidate is returned
    unchanged.
    """
    if plan.size is None or not plan.size.packed:
        return candidate
    max_bytes, file = plan.size.num_bytes, plan.size.file
    names = prepared.input_scene.names
    base_bytes = measure_base(candidate.gaussians, max_bytes, file, candidate.cameras, names)

    def choose_next(built: Sequence[Candidate]) -> int | None:
        """Return the count that seems to fill the size; None if the last build fits after a few are dropped."""
        size, count = measure_bytes(built[-1].gaussians, file, built[-1].cameras, names), len(built[-1].gaussians)
        # unseen Gaussians were dropped from the requested number; the bytes that they free are not filled up
        requested = max(count, built[-1].count or 0)
        full_size = base_bytes + (size - base_bytes) * requested / max(count, 1)  # bytes with the dropped Gaussians
        full_count = min(
            int(BUILD_SURPLUS * count * (max_bytes - base_bytes) / max(size - base_bytes, 1)), plan.limits.most
        )
        near_share = 0.97  # share of the size that a build has to reach
        is_near = full_size >= near_share * max_bytes or full_count <= BUILD_SURPLUS * requested
        most_dropped = 0.08  # largest share of the Gaussians that is dropped after the last build
        fits = full_count >= (1 - most_dropped) * count and is_near
        return None if fits or len(built) > MAX_REBUILDS else full_count

    candidate = build_in_turn(rebuild, candidate, choose_next)[-1]
    gaussians = drop_to_bytes(candidate.gaussians, max_bytes, file, candidate.cameras, names, base_bytes)
    return candidate if len(gaussians) == len(candidate.gaussians) else rescore(candidate, gaussians, prepared, plan)


def measure_base(
    gaussians: Gaussians, max_bytes: int, file: Format, cameras: Cameras, names: Sequence[str] = ()
) -> int:
    """Return the bytes of a file with one Gaussian; UsageError if they are more than ``max_bytes``."""
    base_bytes = measure_bytes(gaussians[:1], file, cameras, names)
    if base_bytes > max_bytes:
        problem = f"expected at least {human_bytes(base_bytes)} for a {file.ending} with one Gaussian"
        raise UsageError(f"budget: {problem}, got {human_bytes(max_bytes)}")
    return base_bytes


def drop_to_bytes(
    gaussians: Gaussians, max_bytes: int, file: Format, cameras: Cameras, names: Sequence[str], base_bytes: int
) -> Gaussians:
    """Keep about as many of the largest and most opaque Gaussians as fit into ``max_bytes``.

    ``base_bytes`` are the bytes of a file with one Gaussian.
    """
    low, high = 0, len(gaussians)  # the largest count that is known to fit, and the largest that may fit
    best, count = gaussians[:0], len(gaussians)
    full_share = 0.985  # a file with this share of ``max_bytes`` is full enough
    for _ in range(MOST_MEASURED):
        trial = gaussians if count == len(gaussians) else faintest_dropped(gaussians, count)
        size = measure_bytes(trial, file, cameras, names)
        if size <= max_bytes:
            low, best = count, trial
        else:
            high = count - 1
        if low == len(gaussians) or (low and full_share * max_bytes <= size <= max_bytes) or low >= high:
            break
        next_count = int(count * ((1 + full_share) / 2 * max_bytes - base_bytes) / max(size - base_bytes, 1))
        count = min(max(low + 1, next_count), high)
    return best
