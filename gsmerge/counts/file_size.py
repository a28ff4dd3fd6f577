"""Meet a budget in bytes, in compressed formats, where the number of Gaussians alone does not give the bytes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from gsmerge.counts.clean_up import build_candidate
from gsmerge.errors import UsageError
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.pipelines.plan import FileSize, Plan
from gsmerge.method.stages.clean import faintest_dropped
from gsmerge.results.candidate import Candidate, rescore
from gsmerge.runtime.memory import human_bytes
from gsmerge.runtime.record import add_seconds, note
from gsmerge.types import Cameras, Gaussians

BUILD_SURPLUS = 1.02  # Gaussians of a build, relative to the number that seems to fit
MOST_MEASURED = 8  # most files that are measured to choose how many Gaussians are dropped
MAX_REBUILDS = 2  # most builds after the first one


def meet_bytes(candidate: Candidate, prepared: Prepared, plan: Plan) -> Candidate:
    """Make the file of a candidate nearly as large as a budget in bytes allows.

    The candidate is rebuilt with other counts until its file is about as large as allowed. The faintest Gaussians of
    the last build are dropped until the file fits.
    """
    size = plan.count.file_size
    assert size is not None, "a budget in bytes"
    max_bytes = size.num_bytes
    names = prepared.input_scene.names
    base_bytes = measure_least_bytes(candidate.gaussians, size, candidate.cameras, names)

    def choose_next(built: Sequence[Candidate]) -> int | None:
        """Return the count whose file is expected to be as large as allowed; None if the last build is near enough."""
        last = built[-1]
        count = len(built[-1].gaussians)
        num_bytes = size.measure(last.gaussians, last.cameras, names)
        expected_count = int(BUILD_SURPLUS * count * (max_bytes - base_bytes) / max(num_bytes - base_bytes, 1))
        next_count = min(expected_count, plan.count.limits.most)
        # Gaussians that no view sees were dropped from the requested number, and no other Gaussians take their place
        requested_count = max(count, last.count or 0)
        requested_bytes = base_bytes + (num_bytes - base_bytes) * requested_count / max(count, 1)
        near_share = 0.97  # share of the allowed bytes that is near enough
        is_large_enough = requested_bytes >= near_share * max_bytes or next_count <= BUILD_SURPLUS * requested_count
        most_dropped = 0.08  # largest share of the Gaussians that may be dropped from the last build
        is_small_enough = next_count >= (1 - most_dropped) * count
        return None if (is_large_enough and is_small_enough) or len(built) > MAX_REBUILDS else next_count

    built = [candidate]
    while (count := choose_next(built)) is not None:
        candidate = build_candidate(prepared, plan, count)
        add_seconds(candidate.record.seconds)
        built.append(candidate)
    gaussians = drop_to_bytes(candidate.gaussians, size, candidate.cameras, names, base_bytes)
    return candidate if len(gaussians) == len(candidate.gaussians) else rescore(candidate, gaussians, prepared, plan)


def choose_harmonics(candidate: Candidate, prepared: Prepared, plan: Plan) -> Candidate:
    """Build Gaussians without harmonics, of which more fit into the file; return the better one of both candidates."""
    size = plan.count.file_size
    assert size is not None, "a budget in bytes"
    assert size.count_without_harmonics is not None, "a scene with harmonics"
    gaussians = prepared.scene.gaussians
    plain = replace(prepared, scene=replace(prepared.scene, gaussians=replace(gaussians, shN=gaussians.shN[:, :0])))
    other = build_candidate(plain, plan, min(size.count_without_harmonics, plan.count.limits.most))
    add_seconds(other.record.seconds)
    if size.packed:
        other = meet_bytes(other, plain, plan)
    if other.psnr is None or candidate.psnr is None or other.psnr <= candidate.psnr:
        return candidate
    counts = f"{len(other.gaussians):,} Gaussians fit in place of {len(candidate.gaussians):,}"
    note(f"harmonics are left out: {counts}, and have {other.psnr:.1f} dB in place of {candidate.psnr:.1f}")
    return other


def measure_least_bytes(gaussians: Gaussians, size: FileSize, cameras: Cameras, names: Sequence[str] = ()) -> int:
    """Return the bytes of a file with one Gaussian; UsageError if this file is larger than ``size`` allows."""
    base_bytes = size.measure(gaussians[:1], cameras, names)
    if base_bytes > size.num_bytes:
        problem = f"expected at least {human_bytes(base_bytes)} for a {size.ending} with one Gaussian"
        raise UsageError(f"budget: {problem}, got {human_bytes(size.num_bytes)}")
    return base_bytes


def drop_to_bytes(
    gaussians: Gaussians, size: FileSize, cameras: Cameras, names: Sequence[str], base_bytes: int
) -> Gaussians:
    """Keep about as many of the largest and most opaque Gaussians as fit into a file of ``size``.

    ``base_bytes`` are the bytes of a file with one Gaussian.
    """
    max_bytes = size.num_bytes
    # the largest count that is known to fit, and the largest that may
    fitting_count = 0
    most_count = len(gaussians)
    fitting = gaussians[:0]
    count = len(gaussians)
    full_share = 0.985  # a file with this share of ``max_bytes`` is full enough
    for _ in range(MOST_MEASURED):
        kept = gaussians if count == len(gaussians) else faintest_dropped(gaussians, count)
        num_bytes = size.measure(kept, cameras, names)
        if num_bytes <= max_bytes:
            fitting_count = count
            fitting = kept
        else:
            most_count = count - 1
        if fitting_count >= most_count or (fitting_count and full_share * max_bytes <= num_bytes <= max_bytes):
            break
        expected_count = int(count * ((1 + full_share) / 2 * max_bytes - base_bytes) / max(num_bytes - base_bytes, 1))
        count = min(max(fitting_count + 1, expected_count), most_count)
    return fitting
