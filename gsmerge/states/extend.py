"""State and new views -> state: groups matched and merged into it, and fitted to their photos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from gsmerge import __version__
from gsmerge.compaction.search import choose_count
from gsmerge.errors import UsageError
from gsmerge.facts.prepare import prepare
from gsmerge.facts.views import concat_cameras, in_float64
from gsmerge.pipeline import build
from gsmerge.plan import make_plan, require_children
from gsmerge.runtime.record import Progress, choose, note, record_run, stage
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.budget import AUTO
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.extend import ExtendOptions
from gsmerge.settings.stages import MAX_CHILDREN, MIXED, USUAL_K
from gsmerge.stages.decode import keep_all, merged_count
from gsmerge.stages.merge import MergedViews, take
from gsmerge.stages.segment import knee_count
from gsmerge.states.extend_decoded import DECODED
from gsmerge.states.extend_latents import LATENTS, keeps_latents, own_checkpoint
from gsmerge.states.groups import select_groups, share, share_groups
from gsmerge.states.state import DividedGroups, GroupSet, State, StoredSettings, no_photos
from gsmerge.states.view_batch import (
    Batch,
    BatchFeatures,
    StateKind,
    fit_batch_colors,
    make_batch,
    novel_rows,
    rows_in_view,
    update_replay,
)
from gsmerge.types import Gaussians, Scene

USUAL_MAX_K = 4  # children that are stored of a group, unless more are asked for, or a number of Gaussians is


@dataclass(frozen=True)
class BatchReport:
    """Report of one batch: numbers of views and groups, and the record of the run."""

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
    state: State | None,
    scene: Scene,
    options: CompactOptions | None = None,
    extend_options: ExtendOptions | None = None,
    *,
    progress: Progress | None = None,
) -> tuple[State, BatchReport]:
    """Add a batch of views to a state (paper section 4.5, "Online reconstruction").

    ``state``: state after the earlier batches, which is not changed; None: this is the first batch. ``scene``: the new
    views, in the same world as the earlier ones; tensors become arrays. ``extend_options``: which part of the batch
    enters the state, and how. Raises ValueError if a setting is out of range or impossible for a state, or if the SH
    degree differs from that of the state.
    """
    options = options or CompactOptions().with_settings({"fit": "none"})
    extend_options = extend_options or ExtendOptions()
    if state is not None and options.decode.k == AUTO:
        options = replace(options, decode=replace(options.decode, k=USUAL_K))  # whatever the batch is like
    max_k = extend_options.max_k if state is None else state.settings.max_k
    _check(state, scene, options, max_k)
    with use_threads(options.threads), record_run(progress) as record:
        fixed = replace(options.prepare, poses="fixed", exposure="fixed")  # as all other batches
        prepared = prepare(scene.numpy(), fixed, None if state is None else state.frame)
        plan = make_plan(prepared, options, None if state is None else own_checkpoint(state, options))
        require_children("max_k", max_k or 1, plan.checkpoint)
        count = choose_count(prepared, plan, build)
        if keep_all(prepared.scene, count) is not None:
            raise UsageError(f"budget: {count} keeps every Gaussian, which needs no state; use compact without one")
        has_latents = keeps_latents(plan) if state is None else state.keeps_latents
        if keeps_latents(plan) and not has_latents:
            note("the state holds no latents: groups of this batch are decoded when they enter")
        batch, kind = make_batch(state, prepared, plan, extend_options), LATENTS if has_latents else DECODED
        if not batch.is_new.all():
            note(
                f"views with the cameras of earlier ones, which count once: {sum(~batch.is_new)} of {len(batch.is_new)}"
            )
        new = kind.encode(state, batch, count)
        counts = {"num_new": len(new.features), "num_covered": 0, "num_joined": 0, "num_hidden": 0}
        if state is None:
            state = _begin(new, batch, kind)
        else:
            state, others = _join(state, new, batch, kind)
            counts |= others
        if has_latents:
            choose(groups=counts["num_new"], clusters=len(state), **plan.network_facts)
        if prepared.reference.of_views:
            state = _with_photos(state, batch)
    numbers = {"num_views": len(prepared.scene), "num_input": scene.num_gaussians, **counts, "num_groups": len(state)}
    settings = options.to_dict() | asdict(extend_options)
    stored = {name: value for name, value in settings.items() if name != "threads"}  # which depend on the machine
    about = {"gsmerge": __version__, "options": stored, "batches": [*state.about.get("batches", []), numbers]}
    report = BatchReport(
        **numbers, seconds=record.seconds, choices=record.choices, notes=tuple(record.notes), options=settings
    )  # fmt: skip
    return replace(state, about={**state.about, **about}), report


def _begin(new: BatchFeatures, batch: Batch, kind: StateKind) -> State:
    """Make a state from a first batch, whose groups are divided by their own members."""
    prepared, plan, cameras = batch.prepared, batch.plan, batch.photos.cameras
    max_k = _most_children(new, batch)
    groups = kind.divide(new, batch, max_k)
    merged = MergedViews(groups.features, new.members, new.segmentation, len(new.features), new.context)
    decode = replace(plan.decode, k=USUAL_K) if plan.decode.k == MIXED else plan.decode  # slots are those of any number
    count, exact = merged_count(merged, decode, grows=False), new.segmentation.exact
    settings = StoredSettings(
        num_input=prepared.input_scene.num_gaussians,
        k=AUTO if plan.auto_count else plan.decode.k if plan.decode.k == MIXED else min(plan.decode.max_k, max_k),
        max_k=max_k,
        min_opacity=plan.decode.min_opacity,
        min_contribution=plan.fit.min_contribution,
        target_count=count if exact else None,
        num_slots=None if exact or count is None else count // decode.max_k,
        knee_count=knee_count(prepared.scene, plan.superpixels),
    )
    return State(
        groups=groups,
        kept=plan.unseen,
        frame=prepared.frame,
        cameras=in_float64(cameras),
        replay=no_photos(cameras),
        settings=settings,
        about={},
        networks=new.networks,
    )


def _most_children(new: BatchFeatures, batch: Batch) -> int:
    """Return the largest number of children per group that is stored."""
    most, decode = batch.extend_options.max_k, batch.plan.decode
    if most is None:
        asks_for_number = new.segmentation.exact or new.members.pixels is not None
        most = MAX_CHILDREN if asks_for_number or decode.max_k > USUAL_MAX_K else USUAL_MAX_K
    return min(most, new.context.max_children)


def _join(state: State, new: BatchFeatures, batch: Batch, kind: StateKind) -> tuple[State, dict[str, int]]:
    """Add a further batch to a state; return the state, and numbers of the batch's groups by key of the report."""
    state, counts, cameras = share(state), dict[str, int](), batch.photos.cameras
    groups, settings = state.groups, state.settings
    assert isinstance(groups, GroupSet)
    rows = rows_in_view(groups.features, cameras, kind.reach)
    if batch.extend_options.tolerance > 0:
        with stage("cover"):
            novel = novel_rows(new, batch, *kind.decode(select_groups(groups, rows), new))
            counts["num_covered"] = len(new.features) - len(novel)
            new = replace(new, features=take(new.features, novel))
    groups, joined = kind.join(groups, rows, new, batch, settings.max_k)
    settings = replace(
        settings,
        num_input=settings.num_input + batch.num_new,
        k=AUTO if batch.plan.auto_count else batch.plan.decode.k,
        min_contribution=batch.min_contribution,
    )
    state = replace(
        state,
        groups=groups,
        kept=Gaussians.concat([state.kept, batch.plan.unseen]),
        cameras=concat_cameras(state.cameras, cameras[batch.is_new]),
        settings=settings,
        networks=new.networks,
    )
    return state, counts | joined


def _with_photos(state: State, batch: Batch) -> State:
    """Fit colours to a batch's photos, except colours from decoder heads, and store some of the photos."""
    groups = state.groups
    if batch.extend_options.fit_colors and not state.keeps_latents:
        with stage("fit"):
            shared = share_groups(groups, state.cameras, 1) if isinstance(groups, DividedGroups) else groups
            shared, report = fit_batch_colors(shared, batch.photos, batch.plan.fit, batch.plan.seed)
            choose(fit=report.to_dict())
        groups = replace(groups, colors=shared.colors)
    replay = update_replay(state.replay, batch.photos, batch.view_ids, len(state.cameras), batch.extend_options.replay)
    return replace(state, groups=groups, replay=replay)


def _check(state: State | None, scene: Scene, options: CompactOptions, max_k: int | None) -> None:
    """Raise UsageError for settings that are impossible for a state, and for harmonics of another degree."""
    for name in options.compact_only:
        raise UsageError(f"{name}: goes with a whole scene, not with views that come one after the other; use compact")
    if options.fit.fit == "full":
        raise UsageError(
            "fit full: goes with all photos together; expected none, and the full fit when the state is compacted"
        )
    if max_k is not None and options.decode.max_k > max_k:
        raise UsageError(f"max_k: expected at least {options.decode.max_k} for k {options.decode.k}, got {max_k}")
    degree = scene.gaussians.sh_degree
    if state is not None and degree != state.sh_degree:
        expected = state.sh_degree
        raise UsageError(f"expected Gaussians with harmonics of degree {expected} as the state's, got degree {degree}")
