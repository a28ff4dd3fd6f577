"""State -> Gaussians: decoded at any K or number, and fitted to the stored photos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsmerge.budget import exact_count
from gsmerge.errors import UsageError
from gsmerge.fit import FitJob, FitOptions, FitReport, fit, report_steps, start_share, visible_mask
from gsmerge.raster.photos import blank_photos, photos_of
from gsmerge.runtime.record import Progress, record_run, stage
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.budget import AUTO, BudgetOptions
from gsmerge.settings.extend import merge_settings
from gsmerge.settings.stages import MAX_CHILDREN, MIXED, MIXED_COUNTS
from gsmerge.stages.decode import counts_by_saliency, deal_visible
from gsmerge.states.groups import children_of, divide_groups, share
from gsmerge.states.state import DividedGroups, GroupSet, State
from gsmerge.types import Gaussians

OF_MIXED = ("k_low", "k_high", "k_rule")  # settings that say what mixed K is


@dataclass(frozen=True, eq=False)
class DecodeCounts:
    """Number of Gaussians to decode, per group and in all."""

    per_group: np.ndarray  # [g] most Gaussians of each group
    min_contribution: float  # See StoredSettings; 0: contributions are not measured
    total: int | None = None  # Gaussians to be met; None: as many as can be seen
    notes: tuple[str, ...] = ()  # What differs from what was asked for, one sentence each


def count_children(
    state: State,
    groups: DividedGroups,
    *,
    k: int | str | None = None,
    budget: int | str | None = None,
    mixed: Mapping[str, Any] | None = None,
) -> DecodeCounts:
    """Count the Gaussians that each group of a state becomes; see :func:`decode_state`."""
    s = state.settings
    if budget is not None and k is not None:
        raise UsageError("expected one of k and budget, got both")
    auto = AUTO in (budget, s.k) and k is None and budget in (None, AUTO)
    if s.target_count is not None and k is None and (budget is None or (auto and s.k == AUTO)):
        return _distribute(state, groups, s.target_count)
    if auto:
        knee = s.knee_count or len(groups)
        counts = _distribute(state, groups, max(len(groups), knee))
        if knee >= len(groups):
            return counts
        note = f"budget auto would take {knee} Gaussians, fewer than there are groups; begin a state with budget auto"
        return replace(counts, notes=(note,))
    if budget is not None:
        return _distribute(state, groups, _group_budget(state, groups, budget))
    number = s.k if k is None else k
    if number == MIXED:
        return DecodeCounts(_mix(state, groups, mixed or {}), s.min_contribution)
    if not isinstance(number, int) or not 1 <= number <= s.max_k:
        more = "" if s.max_k == MAX_CHILDREN else ", as its first batch set (more with a larger max k)"
        raise UsageError(f"k: expected mixed or 1 to {s.max_k}{more}, got {number!r}")
    if s.num_slots is not None:
        counts = _distribute(state, groups, s.num_slots * number)
        return replace(counts, min_contribution=s.min_contribution, total=None)
    return DecodeCounts(np.full(len(groups), number), s.min_contribution)


def _mix(state: State, groups: DividedGroups, changes: Mapping[str, Any]) -> np.ndarray:
    """Return K = 1, 2 or 4 of every group by its saliency, or as many Gaussians by distortion where they lower it.

    ``changes``: of ``k_low``, ``k_high`` and ``k_rule`` as of the last batch.
    """
    most, max_k = MIXED_COUNTS[-1], state.settings.max_k
    if groups.saliency is None:
        raise UsageError("k mixed: expected a state that knows the saliency of its groups, found one of 0.1")
    if max_k < most:
        raise UsageError(f"k mixed: expected a state begun with a max_k of at least {most}, found {max_k}")
    try:
        options = replace(merge_settings({}, state.about["options"])[0].decode, **changes)
    except ValueError as error:
        raise UsageError(str(error)) from error
    counts = counts_by_saliency(groups.saliency, options)
    if options.k_rule != "distortion":
        return counts
    if max_k > most:  # the order of the further Gaussians looks ahead to more
        raise UsageError(f"k_rule distortion: expected a state begun with max_k {most}, found {max_k}")
    if groups.division.by_heads and isinstance(state.groups, GroupSet):
        raise UsageError("k_rule distortion: expected a state of one batch, found several, whose members are not kept")
    return _distribute(state, groups, int(counts.sum())).per_group


def _group_budget(state: State, groups: DividedGroups, budget: int | str) -> int:
    """Return the part of a budget that remains for the groups."""
    try:
        count = exact_count(BudgetOptions(budget), state.settings.num_input, state.sh_degree)
    except ValueError as error:
        raise UsageError(str(error)) from error
    remedy = "begin a state with that budget"
    if count is None:
        raise UsageError(f"budget: expected a number, a share or a size, got {budget}; {remedy}")
    min_count = len(groups) + len(state.kept)
    if count < min_count:
        raise UsageError(f"budget: expected at least {min_count}, one for each group, got {count}; {remedy}")
    return count - len(state.kept)


def _distribute(state: State, groups: DividedGroups, total: int) -> DecodeCounts:
    """Distribute a number of Gaussians to the groups where they help most."""
    order, extra = groups.division.growth_order, max(0, total - len(groups))
    counts = 1 + np.bincount(order[:extra], minlength=len(groups))
    if extra <= len(order):
        return DecodeCounts(counts, 0.0, total)
    limit, count = len(groups) + len(order) + len(state.kept), total + len(state.kept)
    note = f"{count} Gaussians were asked for, and the groups divide into {limit} at most"
    return DecodeCounts(counts, 0.0, total, (note,))


def decode_counts(state: State, groups: DividedGroups, wanted: DecodeCounts) -> Gaussians:
    """Decode these numbers of canonical Gaussians, without a fit."""
    s, cameras = state.settings, state.cameras
    if wanted.total is None:
        gaussians, _ = children_of(groups, wanted.per_group, cameras)
        gaussians = gaussians[gaussians.opacities >= s.min_opacity]
    else:
        order, total = groups.division.growth_order, wanted.total
        gaussians = deal_visible(
            order, len(groups), total, s.min_opacity, lambda counts: children_of(groups, counts, cameras)[0]
        )
    if wanted.min_contribution > 0:
        gaussians = gaussians[visible_mask(gaussians, blank_photos(cameras, 2), wanted.min_contribution)]
    return Gaussians.concat([gaussians, state.kept])


@dataclass(frozen=True)
class DecodeResult:
    """Result of decoding: Gaussians in the world frame, report of the fit (None without a fit), and notes."""

    gaussians: Gaussians
    fit: FitReport | None
    notes: tuple[str, ...]


def check_fit(state: State, options: FitOptions) -> None:
    """Raise UsageError if a fit is requested and no photos are stored."""
    if options.fit != "none" and not len(state.replay):
        raise UsageError(f"fit {options.fit}: expected a state with photos, found none; extend one with photos")


def decode_state(
    state: State,
    *,
    k: int | str | None = None,
    budget: int | str | None = None,
    mixed: Mapping[str, Any] | None = None,
    options: FitOptions | None = None,
    seed: int = 0,
    threads: int | None = None,
    progress: Progress | None = None,
) -> DecodeResult:
    """Decode a state into Gaussians in the world frame; fit them to stored photos, if any.

    Without a fit, a state of one batch gives what ``compact(scene, fit="none", poses="fixed", exposure="fixed")``
    gives, bit for bit, with the ``k`` or ``budget`` that it was extended with, and with any other ``k`` where neither a
    budget nor the size of the input limits the number of superpixels. Gaussians that no view sees were merged for the
    ``k`` of the batch. States of several batches have the colours that were fitted batch by batch.

    Args:
        state: From :func:`gsmerge.states.extend.extend` or :func:`gsmerge.states.state_file.load_state`.
        k: Gaussians of each group, 1 to the largest number stored, or ``"mixed"``. None: the state's own.
        budget: Gaussians in all instead: a number from one for each group on, a share of the input as "2%", a size as
            "5MB", or ``"auto"``: up to the knee of the superpixels' distortion, where they help most. A full fit begins
            with fewer and grows to the number.
        mixed: ``k_low``, ``k_high`` and ``k_rule`` of mixed K, where they are other than those of the last batch.
        options: The fit. None: the full one at its defaults where there are photos, otherwise none.
        seed: Seed of the fit.
        threads: Threads to use; None: all processors. The result does not depend on it.
        progress: See :func:`gsmerge.compact`.

    Raises:
        UsageError: If a fit is asked for and there are no photos, K or the budget is out of range, or both are given.
    """
    options = options or FitOptions(fit="full" if len(state.replay) else "none")
    check_fit(state, options)
    groups = divide_groups(state, fitted_colors=options.fit == "none")
    counts = count_children(state, groups, k=k, budget=budget, mixed=mixed)
    if options.fit == "none":
        with use_threads(threads):
            return DecodeResult(state.frame.leave(decode_counts(state, groups, counts)), None, counts.notes)
    notes = counts.notes
    if options.photo_scale not in ("auto", 1):
        notes = *notes, f"photo_scale {options.photo_scale:g} is 1: a state stores its photos at the size of its views"
    max_count = int(counts.per_group.sum())
    start_count = max(len(groups), int(start_share(options) * max_count)) + len(state.kept)
    with use_threads(threads), record_run(progress) as record:
        gaussians = decode_counts(state, groups, count_children(state, groups, budget=start_count))
        images = state.replay.images.astype(np.float32) / np.float32(255)
        cameras = state.cameras[state.replay.views]
        photos = photos_of(images, cameras), photos_of(images, cameras, 2)
        with stage("fit"):
            job = FitJob(photos, options, max_count, seed, report_steps)
            gaussians, report = fit(gaussians, job)
        notes = *notes, *record.notes
        if report is not None and not report.accepted:  # then the colours that were fitted batch by batch are better
            note = "the fit was not accepted: held-out patches of the photos did not get better"
            groups, notes = divide_groups(share(state)), (*notes, note)
            gaussians = decode_counts(state, groups, count_children(state, groups, k=k, budget=budget, mixed=mixed))
    return DecodeResult(state.frame.leave(gaussians), report, notes)
