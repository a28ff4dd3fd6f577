"""scene -> merged feature gaussians that are kept, and those -> gaussians, without images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsmerge import __version__
from gsmerge.allocate import parse_budget
from gsmerge.build import merged_groups, wanted_count
from gsmerge.decode import MAX_CHILDREN
from gsmerge.errors import UsageError
from gsmerge.fit import shown
from gsmerge.grouping import Grouping, knee_count, scene_tree
from gsmerge.journal import Journal, Progress
from gsmerge.moments import Members, feature_to_gaussians
from gsmerge.networks import Learned, decode_described, described_by
from gsmerge.options import CompactOptions
from gsmerge.photos import blank_photos
from gsmerge.pipeline import Work, begin, choose_groups, decide, keeps_all
from gsmerge.stored.divide import divide_all, pick_children
from gsmerge.stored.encoded import Encoded, StoredHeads, StoredSettings
from gsmerge.threads import use_threads
from gsmerge.types import FeatureGaussians, Gaussians, LooseScene, PixelScene

USUAL_MOST = 4  # children that are kept of a group, unless a number of Gaussians is to be dealt out


def encode_scene(
    scene: PixelScene | LooseScene,
    options: CompactOptions | None = None,
    *,
    max_k: int | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> Encoded:
    """All of :func:`gsmerge.compact` up to decoding, kept: superpixels, merging, matching, networks; never a fit.

    ``decode_scene(encode_scene(scene, **settings))`` is ``compact(scene, fit="none", **settings)``, bit for bit; so is
    any other ``k`` at decoding where no budget, preset or ``k="auto"`` shaped the superpixels.

    Args:
        scene: As of :func:`gsmerge.compact`.
        options: Settings of all stages; those of the fit do not matter. None: the defaults.
        max_k: Most Gaussians of a group that can be decoded, 1 to 8: more take more space. None: 4, or 8 where ``k``
            is larger or a number of Gaussians is dealt out (budgets, presets, ``k="auto"``, scenes in no order).
        progress: As of :func:`gsmerge.compact`.
        **settings: Single settings by name, on top of ``options``.

    Raises:
        ValueError: If a setting is unknown or out of range, or goes with a fit or another method.
    """
    options = _unfitted((options or CompactOptions()).with_settings(settings), settings)
    if max_k is not None and not 1 <= max_k <= MAX_CHILDREN:
        raise UsageError(f"max k: expected 1 to {MAX_CHILDREN}, got {max_k}")
    if max_k is not None and max_k < options.decode.count:
        raise UsageError(f"max k: expected at least {options.decode.count}, which is k, got {max_k}")
    journal = Journal(progress)
    with use_threads(options.threads), torch.no_grad():
        work = begin(scene, options, journal)
        count = decide(work, journal)
        if keeps_all(work, count):
            raise UsageError(f"budget: {count} keeps every Gaussian, which needs no encoding; use compact")
        grouping = choose_groups(work, count, journal)
        features, members, learned = merged_groups(work.source, grouping, work.options, journal)
        with journal.stage("decode"):
            return _kept(work, grouping, (features, members, learned), max_k, journal)


def _unfitted(options: CompactOptions, settings: dict[str, Any]) -> CompactOptions:
    """The options without a fit.

    Raises:
        UsageError: If a fit, another method, a quality or levels are asked for.
    """
    target = options.target
    asked = {f"fit {options.fit.fit}": settings.get("fit", "none") != "none"}
    asked |= {f"method {options.method}": options.method != "gsmerge", "levels": target.levels > 1}
    asked |= {"max drop": target.max_drop is not None, "target psnr": target.target_psnr is not None}
    for name in (name for name, wanted in asked.items() if wanted):
        raise UsageError(f"{name}: cannot be encoded, as nothing is fitted or searched for; use compact")
    return replace(options, fit=replace(options.fit, fit="none"))


def _kept(
    work: Work,
    grouping: Grouping,
    merged: tuple[FeatureGaussians, Members, Learned | None],
    max_k: int | None,
    journal: Journal,
) -> Encoded:
    """Everything that decoding needs of the merged Feature Gaussians."""
    features, members, learned = merged
    options, scene = work.options, work.source.scene
    wanted = wanted_count(features, members, grouping, options)
    dealt = wanted is not None or options.decode.count > USUAL_MOST
    most = max_k or (MAX_CHILDREN if dealt else USUAL_MOST)
    tree = work.tree or scene_tree(scene, work.canvas, options, work.canvas.usual)
    prunes = scene.images is not None and options.fit.effort != "draft"
    settings = StoredSettings(
        num_input=work.scene.num_gaussians,
        k=options.decode.k,
        most=most,
        min_opacity=options.decode.min_opacity,
        prune=options.fit.prune if prunes else 0.0,
        wanted=wanted if grouping.exact else None,
        places=None if grouping.exact or wanted is None else wanted // options.decode.count,
        knee=knee_count(tree, work.canvas, options),
    )
    heads = None
    if learned is not None:
        described = learned.describe(features)
        heads = StoredHeads(learned.networks, described.views, described.group)
    return Encoded(
        features=replace(
            features, starts=torch.zeros(len(features) + 1, dtype=torch.int64), members=torch.zeros(0).long()
        ),
        division=divide_all(features, members, most, options.encode.rule),
        kept=work.kept,
        frame=work.frame,
        cameras=scene.cameras,
        settings=settings,
        heads=heads,
        about=_about(work.settings, journal),
    )


def _about(options: CompactOptions, journal: Journal) -> dict[str, Any]:
    """Version, options, choices and notes; nothing that depends on the machine."""
    told = options.to_dict()
    del told["threads"]
    checkpoint = {"checkpoint": Path(options.checkpoint).name}
    choices = {name: value for name, value in journal.choices.items() if name != "networks"}
    return {"gsmerge": __version__, "options": told | checkpoint, "choices": choices, "notes": list(journal.notes)}


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
    if k is None and s.wanted is not None or k == "auto" and s.k == "auto" and s.wanted is not None:
        return _dealt(encoded, s.wanted)
    asked = s.k if k is None else k
    if asked == "auto":
        plan = _dealt(encoded, max(len(encoded), s.knee))
        if s.knee >= len(encoded):
            return plan
        note = f"k auto would take {s.knee} Gaussians, fewer than there are groups; encoded with k auto it can"
        return replace(plan, notes=(note,))
    if not isinstance(asked, int) or not 1 <= asked <= s.most:
        most = f'1 to {s.most} or "auto"' + ("" if s.most == MAX_CHILDREN else ", as encoded (more with a larger max k)")
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
        raise UsageError(f"budget: expected at least {least}, one for each group, got {wanted}; encode with that budget")
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
    plan = plan_decode(encoded, k=k, budget=budget)
    features, s = encoded.features, encoded.settings
    with use_threads(threads), torch.no_grad():
        rows, parents = pick_children(encoded.division, plan.counts)
        every = Gaussians.concat([feature_to_gaussians(features), encoded.division.children])
        gaussians = every[torch.from_numpy(rows)]
        if encoded.heads is not None:
            heads = encoded.heads
            described = described_by(features, heads.views, heads.group, encoded.cameras)
            gaussians = decode_described(gaussians, parents, features, described, heads.networks)
        gaussians = gaussians[gaussians.opacities >= s.min_opacity]
        if plan.prune > 0:
            gaussians = gaussians[shown(gaussians, blank_photos(encoded.cameras, 2), plan.prune)]
        if encoded.kept is not None:
            gaussians = Gaussians.concat([gaussians, encoded.kept])
        return encoded.frame.leave(gaussians)
