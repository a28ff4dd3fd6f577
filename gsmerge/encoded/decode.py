"""Encoded scene -> gaussians: a choice among what was kept, without images."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from gsmerge.budget import parse_budget
from gsmerge.encoded.divide import pick_children
from gsmerge.encoded.encoded import Encoded
from gsmerge.errors import UsageError
from gsmerge.moments import feature_to_gaussians, gaussian_members
from gsmerge.networks import NetworkContext, decode_with_group_features, make_group_features
from gsmerge.render.photos import blank_photos
from gsmerge.runtime.threads import use_threads
from gsmerge.stages.decode import MAX_CHILDREN
from gsmerge.stages.fit import visible_mask
from gsmerge.types import Gaussians


@dataclass(frozen=True, eq=False)
class Plan:
    """What a file is decoded to.

    Args:
        counts: ``[g]`` most Gaussians of each group.
        prune: Least contribution to some view, see :class:`StoredSettings`; 0: not looked at.
        notes: What is not quite as asked, one sentence each.
    """

    counts: np.ndarray
    prune: float
    notes: tuple[str, ...] = ()


def plan_decode(encoded: Encoded, *, k: int | str | None = None, budget: int | str | None = None) -> Plan:
    """How many Gaussians each group becomes, see :func:`decode_scene`.

    Raises:
        UsageError: As :func:`decode_scene`.
    """
    s = encoded.settings
    if budget is not None:
        if k is not None:
            raise UsageError("expected one of k and budget, got both")
        return _dealt(encoded, _budget(encoded, budget))
    if s.wanted is not None and (k is None or k == s.k == "auto"):
        return _dealt(encoded, s.wanted)
    asked = s.k if k is None else k
    if asked == "auto":
        plan = _dealt(encoded, max(len(encoded), s.knee))
        if s.knee >= len(encoded):
            return plan
        note = f"k auto would take {s.knee} Gaussians, fewer than there are groups; encoded with k auto it can"
        return replace(plan, notes=(note,))
    if not isinstance(asked, int) or not 1 <= asked <= s.most:
        most = f'1 to {s.most} or "auto"' + (
            "" if s.most == MAX_CHILDREN else ", as encoded (more with a larger max k)"
        )
        raise UsageError(f"k: expected {most}, got {asked!r}")
    if s.places is not None:
        return replace(_dealt(encoded, s.places * asked), prune=s.prune)
    return Plan(np.full(len(encoded), asked), s.prune)


def _budget(encoded: Encoded, budget: int | str) -> int:
    """Gaussians that a budget leaves for the groups."""
    try:
        wanted = parse_budget(budget, encoded.settings.num_input)
    except ValueError as error:
        raise UsageError(str(error)) from error
    least = len(encoded) + encoded.num_kept
    if wanted < least:
        raise UsageError(
            f"budget: expected at least {least}, one for each group, got {wanted}; encode with that budget"
        )
    return wanted - encoded.num_kept


def _dealt(encoded: Encoded, wanted: int) -> Plan:
    """A number of Gaussians, dealt out to the groups where they help most."""
    deals, extra = encoded.division.deals.numpy(), max(0, wanted - len(encoded))
    counts = 1 + np.bincount(deals[:extra], minlength=len(encoded))
    if extra <= len(deals):
        return Plan(counts, 0.0)
    most, asked = len(encoded) + len(deals) + encoded.num_kept, wanted + encoded.num_kept
    return Plan(counts, 0.0, (f"{asked} Gaussians were asked for, and the groups divide into {most} at most",))


def decode_scene(
    encoded: Encoded,
    *,
    k: int | str | None = None,
    budget: int | str | None = None,
    threads: int | None = None,
) -> Gaussians:
    """The Gaussians of an encoded scene, in the scene's own world frame. No fit follows, as there are no photos.

    Args:
        encoded: From :func:`encode_scene` or :func:`load_encoded`.
        k: Gaussians of each group, 1 to what was encoded, or ``"auto"``: as many in all as ``compact`` would take
            without photos, dealt out where they help most. None: as it was encoded.
        budget: Gaussians in all instead: a number from one for each group on, or a share of the input as "2%".
        threads: Threads to use; None: all processors. The result does not depend on it.

    Raises:
        UsageError: If K is more than was encoded, the budget below the number of groups, or both are given.
    """
    plan, s = plan_decode(encoded, k=k, budget=budget), encoded.settings
    with use_threads(threads), torch.no_grad():
        gaussians, _ = children_of(encoded, plan.counts)
        gaussians = gaussians[gaussians.opacities >= s.min_opacity]
        if plan.prune > 0:
            gaussians = gaussians[visible_mask(gaussians, blank_photos(encoded.cameras, 2), plan.prune)]
        if encoded.kept is not None:
            gaussians = Gaussians.concat([gaussians, encoded.kept])
        return encoded.frame.leave(gaussians)


def children_of(encoded: Encoded, counts: np.ndarray) -> tuple[Gaussians, np.ndarray]:
    """At most ``counts [g]`` canonical Gaussians of each group, however faint, and the group of each, rising."""
    features, heads = encoded.features, encoded.heads
    rows, parents = pick_children(encoded.division, counts)
    every = Gaussians.concat([feature_to_gaussians(features), encoded.division.children])
    gaussians = every[torch.from_numpy(rows)]
    if heads is not None:
        group_features = make_group_features(features, heads.views, heads.group, encoded.cameras)
        nothing = gaussian_members(gaussians[:0], np.zeros(0, np.float32))
        networks = NetworkContext(heads.networks, nothing, encoded.cameras)
        gaussians = decode_with_group_features(gaussians, parents, features, group_features, networks)
    return gaussians, parents
