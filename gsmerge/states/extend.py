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
from gsmerge.plan import make_plan, require_children
from gsmerge.runtime.record import Progress, choose, note, record_run, stage
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.budget import AUTO
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.stages import USUAL_K
from gsmerge.stages.decode import keep_all
from gsmerge.stages.merge import take
from gsmerge.states.batch import (
    Batch,
    StateKind,
    fit_batch_colors,
    make_batch,
    novel_rows,
    rows_in_view,
    update_replay,
)
from gsmerge.states.encoded import StoredSettings
from gsmerge.states.extend_latents import LATENTS, keeps_latents, own_checkpoint
from gsmerge.states.extend_moments import MOMENTS
from gsmerge.states.options import OnlineOptions
from gsmerge.states.state import GroupSet, OnlineState, no_photos, select_groups
from gsmerge.types import Gaussians, Scene


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
    state: OnlineState | None,
    scene: Scene,
    options: CompactOptions | None = None,
    online: OnlineOptions | None = None,
    *,
    progress: Progress | None = None,
) -> tuple[OnlineState, BatchReport]:
    """Add a batch of views to a state (paper section 4.5, "Online reconstruction").

    ``state``: what earlier batches left, which is not changed; None: this is the first batch. ``scene``: the new views,
    in the same world as the earlier ones; tensors become arrays. ``online``: which part of the batch enters the state,
    and how. Raises ValueError if a setting is out of range or not possible for a state, or the SH degree differs from
    the state's.
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
        has_latents = keeps_latents(plan) if state is None else state.networks is not None
        if keeps_latents(plan) and not has_latents:
            note("the state holds no latents: groups of this batch are decoded when they enter")
        batch = make_batch(state, prepared, plan, online, max_k)
        if not batch.is_new.all():
            note(
                f"views with the cameras of earlier ones, which count once: {sum(~batch.is_new)} of {len(batch.is_new)}"
            )
        state, counts = _add_batch(state, batch, LATENTS if has_latents else MOMENTS, count)
    numbers = {"num_views": len(prepared.scene), "num_input": scene.num_gaussians, **counts, "num_groups": len(state)}
    settings = options.to_dict() | asdict(online)
    stored = {name: value for name, value in settings.items() if name != "threads"}  # which depend on the machine
    about = {"gsmerge": __version__, "options": stored, "batches": [*state.about.get("batches", []), numbers]}
    report = BatchReport(
        **numbers, seconds=record.seconds, choices=record.choices, notes=tuple(record.notes), options=settings
    )  # fmt: skip
    return replace(state, about=about), report


def _add_batch(
    state: OnlineState | None, batch: Batch, kind: StateKind, count: int | None
) -> tuple[OnlineState, dict[str, int]]:
    """Add a batch to the state; return it, and the numbers of the batch's groups by key of the report."""
    new = kind.encode(state, batch, count)
    counts = {"num_new": len(new.features), "num_covered": 0, "num_joined": 0, "num_hidden": 0}
    if state is None:
        groups = kind.first(new, batch)
    else:
        rows = rows_in_view(state.groups.features, batch.photos.cameras, kind.reach)
        if batch.online.tolerance > 0:
            with stage("cover"):
                novel = novel_rows(new, batch, *kind.decode(select_groups(state.groups, rows), new))
                counts["num_covered"] = len(new.features) - len(novel)
                new = replace(new, features=take(new.features, novel))
        groups, joined = kind.join(state.groups, rows, new, batch)
        counts |= joined
    if new.networks is not None and batch.plan.checkpoint is not None:
        choose(groups=counts["num_new"], clusters=len(groups), networks=batch.plan.checkpoint.facts())
    state = replace(_with_views(state, groups, batch), networks=new.networks)
    if batch.prepared.input_scene.images is None:
        return state, counts
    if batch.online.fit_colors and new.networks is None:
        with stage("fit"):
            groups, report = fit_batch_colors(groups, batch.photos, batch.plan.fit, batch.plan.seed)
            choose(fit=report.to_dict())
    replay = update_replay(state.replay, batch.photos, batch.view_ids, len(state.cameras), batch.online.replay)
    return replace(state, groups=groups, replay=replay), counts


def _with_views(state: OnlineState | None, groups: GroupSet, batch: Batch) -> OnlineState:
    """Return the state with other groups, and with the views and unseen Gaussians of a batch."""
    plan, input_scene, cameras = batch.plan, batch.prepared.input_scene, batch.photos.cameras[batch.is_new]
    k = AUTO if plan.auto_count else plan.decode.k
    if state is None:
        least = plan.fit.min_contribution if input_scene.images is not None else 0.0
        return OnlineState(
            groups=groups,
            kept=plan.unseen,
            frame=batch.prepared.frame,
            cameras=in_float64(cameras),
            replay=no_photos(cameras),
            settings=StoredSettings(input_scene.num_gaussians, k, batch.max_k, plan.decode.min_opacity, least),
            about={},
        )
    kept = [gaussians for gaussians in (state.kept, plan.unseen) if gaussians is not None]
    return replace(
        state,
        groups=groups,
        kept=Gaussians.concat(kept) if kept else None,
        cameras=concat_cameras(state.cameras, cameras),
        settings=replace(state.settings, num_input=state.settings.num_input + batch.num_new, k=k),
    )


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
