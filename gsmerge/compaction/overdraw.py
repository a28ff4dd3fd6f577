"""Meet the overdraw that a device allows: fewer Gaussians, which are larger, and without those that add least."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from gsmerge.compaction.file_size import Rebuild
from gsmerge.compaction.result import Candidate, move_views, shrink
from gsmerge.facts.prepare import Prepared
from gsmerge.measure.overdraw import Overdraw, Pictures, overdraw_pictures
from gsmerge.plan import Plan
from gsmerge.raster.photos import NEAR
from gsmerge.runtime.record import choose, note, stage
from gsmerge.settings.budget import Device
from gsmerge.types import Cameras, Gaussians

LEFT_OUT = 1.15  # times the limit from which leaving Gaussians out costs no more than a run with fewer does
POWER, FEWEST = 4, 0.2  # overdraw goes with this root of the count; least share of the count to try next
MAX_REBUILDS, TRIES = 2, 9
MOST_LEFT_OUT = 0.5  # share of the Gaussians: without more of them nothing is left to look at
NEAR_LIMIT = 0.97  # share of the limit that is close enough


def meet_overdraw(candidate: Candidate, rebuild: Rebuild, prepared: Prepared, plan: Plan) -> Candidate:
    """Make a candidate again with fewer Gaussians, and leave out some, until its device draws it fluidly."""
    device = plan.device
    if device is None or math.isinf(device.overdraw):
        return candidate
    moved = move_views(prepared, candidate.fitted.cameras)
    canonical = moved.frame.enter(candidate.gaussians)
    pictures = overdraw_pictures(canonical, moved.scene.cameras, device.side, NEAR)
    first = found = _measure(pictures, canonical)
    for _ in range(MAX_REBUILDS):
        excess, count = _excess(found, device), len(canonical)
        fewer = max(plan.limits.min_count, round(count * max(excess**-POWER, FEWEST)))
        if excess <= LEFT_OUT or fewer >= count:
            break
        smaller = rebuild(fewer)
        measured = _measure(pictures, moved.frame.enter(smaller.gaussians))
        if _excess(measured, device) > excess:  # without a fit, fewer may be larger by more
            break
        candidate, found = smaller, measured
        canonical = moved.frame.enter(candidate.gaussians)
    if _excess(found, device) > 1:
        with stage("overdraw"):
            rows = _rows_within(pictures, canonical, device)
        if rows is not None:
            candidate = shrink(candidate, candidate.gaussians[rows], prepared, plan)
            found = _measure(pictures, canonical[rows])
    note_overdraw(first, found, device)
    return candidate


def report_overdraw(gaussians: Gaussians, cameras: Cameras, device: Device | None) -> None:
    """Say in the record what the overdraw of canonical Gaussians is, if their device limits it."""
    if device is not None and math.isfinite(device.overdraw):
        found = _measure(overdraw_pictures(gaussians, cameras, device.side, NEAR), gaussians)
        note_overdraw(found, found, device)


def note_overdraw(first: Mapping[str, Overdraw], found: Mapping[str, Overdraw], device: Device) -> None:
    """Say in the record what overdraw was and is, and what the device draws fluidly."""
    before, after = ({kind: asdict(overdraw) for kind, overdraw in kinds.items()} for kinds in (first, found))
    met = _excess(found, device) <= 1
    limit = {"num_gaussians": device.count, "mean": device.overdraw, "crowded": device.crowded}
    choose(overdraw={"before": before, "after": after, "limit": limit, "met": met})
    if not met:
        worst = max(found.values(), key=lambda overdraw: overdraw.excess(device))
        note(
            f"overdraw: {worst.mean:.0f} Gaussians in a pixel on average, {worst.crowded:.0f} in crowded ones, where"
            f" the device draws {device.overdraw:g} and {device.crowded:g} fluidly"
        )


@stage("overdraw")
def _measure(pictures: Pictures, gaussians: Gaussians) -> dict[str, Overdraw]:
    return pictures.measure(gaussians)


def _excess(found: Mapping[str, Overdraw], device: Device) -> float:
    return max(overdraw.excess(device) for overdraw in found.values())


def _rows_within(pictures: Pictures, gaussians: Gaussians, device: Device) -> np.ndarray | None:
    """Choose rows within the limit of a device: without those that add least for what they cost; None if too few."""
    order = pictures.order_by_worth(gaussians)
    most = int(MOST_LEFT_OUT * len(order))
    low, high, tried = 0, None, most // 8  # numbers that are left out: too few, and enough
    for _ in range(TRIES):
        excess = _excess(pictures.measure(gaussians[np.sort(order[tried:])]), device)
        low, high = (tried, high) if excess > 1 else (low, tried)
        if NEAR_LIMIT <= excess <= 1 or low == most or (high is not None and high - low <= 1):
            break
        tried = min(3 * low + 1, most) if high is None else (low + high) // 2
    return None if high is None else np.sort(order[high:])
