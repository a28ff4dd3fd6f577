"""State and new views -> state: groups matched and merged into it, and fitted to their photos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from gsmerge import __version__
from gsmerge.compaction.search import choose_count
from gsmerge.errors import UsageError
from gsmerge.facts.prepare import Prepared, prepare
from gsmerge.fit import visible_mask
from gsmerge.moments import feature_to_gaussians
from gsmerge.online.batch_photos import (
    BatchPhotos,
    fit_batch_colors,
    novel_rows,
    photos_of_batch,
    rows_in_view,
    update_replay,
)
from gsmerge.online.extend_features import add_features, keeps_features, own_checkpoint
from gsmerge.online.options import OnlineOptions
from gsmerge.online.state import (
    GroupSet,
    OnlineState,
    bake,
    concat_groups,
    first_state,
    grown_state,
    limit_children,
    replace_groups,
    select_groups,
    with_fitted_colors,
)
from gsmerge.pipeline import merge_views
from gsmerge.plan import Plan, make_plan, require_children
from gsmerge.runtime.record import Progress, choose, note, record_run, stage
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.budget import AUTO
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.stages import USUAL_K
from gsmerge.stages.decode import keep_all
from gsmerge.stages.match import MatchOptions, match
from gsmerge.stages.merge import MergedViews, merge, take
from gsmerge.types import FeatureGaussians, Gaussians, Matches, Scene


@dataclass(frozen=True)
class BatchReport:
    """Report of a batch of views: numbers of its groups, and the record of the run."""

    num_views: int
    num_input: int  # Gaussians of the batch
    num_new: int  # Groups that it became, merged across its own views; with networks kept, before that
    num_covered: int  # Of these, left out because the state shows their pixels as well
    num_joined: int  # Of the rest, those that were merged into groups of the state
    num_hidden: int  # Of the rest, left out because none of the batch's views shows them
    num_groups: int  # Groups of the state afterwards
    seconds: Mapping[str, float]  # Wall time of each stage
    choices: Mapping[str, Any]  # What the stages decided
    notes: tuple[str, ...]  # Warnings, one sentence each
    options: Mapping[str, Any]  # All settings, by their names in reports


def extend(
    state: OnlineState | None,
    scene: Scene,
    options: CompactOptions | None = None,
    online: OnlineOptions | None = None,
    *,
    progress: Progress | None = None,
) -> tuple[OnlineState, BatchReport]:
    """Add a batch of views to a state (paper section 4.5, "Online reconstruction").

    ``state``: what earlier batches left, unchanged; None: this is the first one. ``scene``: the new
    views, in the same world as the earlier ones; tensors become arrays. ``online``: which part of
    the batch enters the state, and how. Raises ValueError if a setting is out of range or asks for
    what a state cannot have, or the degree of the harmonics is not that of the state.
    """
    options, online = options or CompactOptions().with_settings({"fit": "none"}), online or OnlineOptions()
    if options.decode.k == AUTO:
        options = replace(options, decode=replace(options.decode, k=USUAL_K))  # whatever the first batch is like
    max_k = online.max_k if state is None else state.settings.max_k
    _check(state, scene, options, max_k)
    with use_threads(options.threads), record_run(progress) as record:
        fixed = replace(options.prepare, poses="fixed", exposure="fixed")  # as all other batches
        prepared = prepare(scene.numpy(), fixed, None if state is None else state.frame)
        plan = make_plan(prepared, options, None if state is None else own_checkpoint(state, options))
        plan = plan.with_fit(replace(plan.fit, min_contribution=options.fit.min_contribution))  # in drafts, too
        require_children("max_k", max_k, plan.checkpoint)
        count = choose_count(prepared, plan)
        if keep_all(prepared.scene, count) is not None:
            raise UsageError(f"budget: {count} keeps every Gaussian, which needs no state; use compact")
        if keeps_features(plan) if state is None else state.networks is not None:
            state, counts = add_features(state, prepared, plan, count, online, max_k)
        else:
            if state is not None and keeps_features(plan):
                note("the state holds no latents: groups of this batch are decoded when they enter")
            merged = merge_views(prepared, plan, count)
            state, counts = _add_batch(state, prepared, plan, merged, online, max_k)
    numbers = {"num_views": len(prepared.scene), "num_input": scene.num_gaussians, **counts, "num_groups": len(state)}
    settings = options.to_dict() | asdict(online)
    stored = {name: value for name, value in settings.items() if name != "threads"}  # which depend on the machine
    about = {"gsmerge": __version__, "options": stored, "batches": [*state.about.get("batches", []), numbers]}
    report = BatchReport(
        **numbers, seconds=record.seconds, choices=record.choices, notes=tuple(record.notes), options=settings
    )  # fmt: skip
    return replace(state, about=about), report


def _add_batch(
    state: OnlineState | None,
    prepared: Prepared,
    plan: Plan,
    merged: MergedViews,
    online: OnlineOptions,
    max_k: int,
) -> tuple[OnlineState, dict[str, int]]:
    """Add a batch to the state; return it, and the numbers of the batch's groups by key of the report."""
    scene = prepared.scene
    photos, ids = photos_of_batch(scene, None if state is None else state.cameras)
    counts = {"num_new": len(merged.features), "num_covered": 0, "num_joined": 0, "num_hidden": 0}
    features, rows = merged.features, np.zeros(0, np.int64)
    if state is not None:
        with stage("cover"):
            rows = rows_in_view(state.groups.features, photos.cameras)
            there = feature_to_gaussians(with_fitted_colors(select_groups(state.groups, rows)).features)
            own = feature_to_gaussians(features)
            novel = novel_rows(there, own, features, merged.members, photos.photos(2), scene.cameras, online)
            counts["num_covered"] = len(features) - len(novel)
            features = take(features, novel)
    with stage("decode"):
        new = bake(features, merged.members, merged.networks, max_k)
    with stage("join"):
        if state is None:
            state = first_state(new, prepared, plan, max_k)
        else:
            groups, entered = _enter(state.groups, new, prepared, plan, photos, rows, max_k)
            state = grown_state(state, groups, prepared, plan, photos.cameras[ids >= len(state.cameras)])
            counts |= entered
    if prepared.given.images is None:
        return state, counts
    groups = state.groups
    if online.fit_colors:
        with stage("fit"):
            groups, report = fit_batch_colors(groups, photos, plan.fit, plan.seed)
            choose(fit=report.to_dict())
    replay = update_replay(state.replay, photos, ids, len(state.cameras), online.replay)
    return replace(state, groups=groups, replay=replay), counts


def _check(state: OnlineState | None, scene: Scene, options: CompactOptions, max_k: int) -> None:
    """Refuse settings that no state can have, and harmonics of another degree."""
    for name in options.compact_only:
        raise UsageError(f"{name}: goes with a whole scene, not with views that come one after the other; use compact")
    if options.fit.fit == "full":
        raise UsageError("fit full: goes with all photos together; expected none, and the full fit at decoding")
    if options.decode.max_k > max_k:
        raise UsageError(f"max_k: expected at least {options.decode.k}, which is k, got {max_k}")
    degree = scene.gaussians.sh_degree
    if state is not None and degree != state.sh_degree:
        expected = state.sh_degree
        raise UsageError(f"expected Gaussians with harmonics of degree {expected} as the state's, got degree {degree}")


def _enter(
    groups: GroupSet, new: GroupSet, prepared: Prepared, plan: Plan, photos: BatchPhotos, rows: np.ndarray, max_k: int
) -> tuple[GroupSet, dict[str, int]]:
    """Merge new groups into the state's ``rows`` in view, and add those that a view shows; return groups and counts."""
    partners = find_partners(take(groups.features, rows), new.features, plan.match)
    has_partner = partners >= 0
    joining = select_groups(new, np.flatnonzero(has_partner))
    groups = merge_into(groups, joining, rows[partners[has_partner]], max_k)
    alone = select_groups(new, np.flatnonzero(~has_partner))
    counts = {"num_joined": int(has_partner.sum())}
    if plan.fit.min_contribution > 0 and prepared.scene.images is not None:
        in_view = feature_to_gaussians(take(groups.features, rows))
        both = Gaussians.concat([in_view, feature_to_gaussians(alone.features)])
        visible = visible_mask(both, photos.photos(2), plan.fit.min_contribution)[len(in_view) :]
        counts["num_hidden"] = int((~visible).sum())
        alone = select_groups(alone, np.flatnonzero(visible))
    return concat_groups([groups, alone]), counts


def find_partners(features: FeatureGaussians, new: FeatureGaussians, options: MatchOptions) -> np.ndarray:
    """Return the state's group with the same surface as each new one, ``[n]`` int64, -1 for none.

    No group gets two: of several in a cluster by boxes, the first. Matched as across the views of one batch, the state
    being one view and the batch another.
    """
    both = FeatureGaussians.concat([features, new])
    sides = (np.arange(len(both)) >= len(features)).astype(np.int64)
    matches = match(replace(both, views=sides), replace(options, cluster_size=2))
    owner = np.full(matches.count, -1)
    owner[matches.clusters[: len(features)]] = np.arange(len(features))
    partners = owner[matches.clusters[len(features) :]]
    again = np.ones(len(partners), bool)
    again[np.unique(partners, return_index=True)[1]] = False
    partners[again] = -1
    return partners


def merge_into(groups: GroupSet, new: GroupSet, rows: np.ndarray, max_k: int) -> GroupSet:
    """Merge n new groups into those of the state at ``rows [n]`` int64, all different: moments add up, in place."""
    if len(rows) == 0:
        return groups
    old = select_groups(groups, rows)
    both = concat_groups([old, new])
    pairs = np.tile(np.arange(len(rows)), 2)
    features = merge(both.features, Matches(pairs, len(rows)))
    children = both.children[features.members]
    fitted_sh0 = np.where((old.color_precision > 0)[:, None, None], old.fitted_sh0, features.sh0)
    merged = GroupSet(replace(features, members=np.arange(len(children))), children, fitted_sh0, old.color_precision)
    return replace_groups(groups, rows, limit_children(merged, max_k))
