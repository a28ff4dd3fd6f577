"""State + new views -> state: grouped, encoded, matched and merged into what is there, and fitted to their photos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch

from gsmerge import __version__
from gsmerge.encoded.encoded import StoredSettings
from gsmerge.errors import UsageError
from gsmerge.moments import feature_to_gaussians
from gsmerge.online.colors import solve_colors
from gsmerge.online.cover import group_errors, pixel_errors, rows_in_view
from gsmerge.online.join import absorb, partners
from gsmerge.online.options import OnlineOptions
from gsmerge.online.pictures import Shots, joined_cameras, kept_photos, resized, shots_at, view_places
from gsmerge.online.state import OnlineState, Parts, baked, joined, no_photos, pick, with_solved
from gsmerge.options import CompactOptions
from gsmerge.pipeline import build, merge_views
from gsmerge.render.photos import scene_pictures
from gsmerge.runtime.run_log import Progress, RunLog
from gsmerge.runtime.threads import use_threads
from gsmerge.search import choose_count
from gsmerge.stages.fit import visible_mask
from gsmerge.stages.merge import MergedViews, take
from gsmerge.stages.prepare import PreparedScene, prepare
from gsmerge.types import Gaussians, PixelScene, UnalignedScene


@dataclass(frozen=True)
class BatchReport:
    """What became of a batch of views.

    Args:
        num_views: Views of the batch.
        num_input: Gaussians of the batch.
        num_new: Groups that it was cut to and merged to among its own views.
        num_covered: Of these, left out because the state shows their pixels as well.
        num_joined: Of the rest, those that became part of groups that were there.
        num_hidden: Of the rest, left out because none of the batch's views shows them.
        num_groups: Groups of the state afterwards.
        seconds: Wall time of each stage.
        choices: What the stages decided.
        notes: Things worth telling, one sentence each.
        options: All settings by flat name.
    """

    num_views: int
    num_input: int
    num_new: int
    num_covered: int
    num_joined: int
    num_hidden: int
    num_groups: int
    seconds: Mapping[str, float]
    choices: Mapping[str, Any]
    notes: tuple[str, ...]
    options: Mapping[str, Any]


def extend(
    state: OnlineState | None,
    scene: PixelScene | UnalignedScene,
    options: CompactOptions | None = None,
    online: OnlineOptions | None = None,
    *,
    progress: Progress | None = None,
) -> tuple[OnlineState, BatchReport]:
    """Add a batch of views to a state (paper section 4.5, "Online reconstruction").

    Args:
        state: What earlier batches left; None: this is the first one.
        scene: The new views, in the same world as the earlier ones.
        options: Settings of all stages; None: the defaults, with the fit of the colours.
        online: What of the batch enters the state, and how; None: the defaults.
        progress: As of :func:`gsmerge.compact`.

    Returns:
        The new state, the old one left as it is, and what was done.

    Raises:
        ValueError: If a setting is out of range or asks for what a state cannot have, or the degree of the harmonics
            is not that of the state.
    """
    options, online = options or CompactOptions().with_settings({"fit": "color"}), online or OnlineOptions()
    _check(state, scene, options, online.max_k if state is None else state.settings.most)
    log = RunLog(progress)
    with use_threads(options.threads), torch.no_grad():
        prepared = prepare(scene, options, log, None if state is None else state.frame)
        prepared = replace(prepared, limits=replace(prepared.limits, share=1.0))  # nothing grows here
        count = choose_count(prepared, build, log)
        if prepared.keeps_all(count):
            raise UsageError(f"budget: {count} keeps every Gaussian, which needs no state; use compact")
        merged = merge_views(prepared, count, log)
        shots = _shots(state, prepared)
        counts = {"num_new": len(merged.features), "num_covered": 0, "num_joined": 0, "num_hidden": 0}
        rows = torch.zeros(0, dtype=torch.int64)
        if state is not None:
            with log.stage("cover"):
                rows = rows_in_view(state.parts.features, shots.cameras)
                fresh = _uncovered(pick(state.parts, rows), merged, shots, prepared.scene, online)
                counts["num_covered"] = len(merged.features) - len(fresh)
                merged = replace(merged, features=take(merged.features, fresh))
        most = online.max_k if state is None else state.settings.most
        places = np.arange(len(shots)) if state is None else view_places(state.cameras, shots.cameras)
        with log.stage("decode"):
            new = baked(merged.features, merged.members, merged.networks, most, options.encode.rule)
        with log.stage("join"):
            state, found = _entered(state, new, prepared, (shots, places, rows), online)
            counts |= found
        if prepared.given.images is not None:
            state = _with_photos(state, (shots, places), prepared.options, online, log)
    numbers = {"num_views": len(prepared.scene), "num_input": scene.num_gaussians, **counts}
    told = options.to_dict() | asdict(online)
    done = BatchReport(
        **numbers, num_groups=len(state), seconds=log.seconds, choices=log.choices,
        notes=tuple(log.notes), options=told,
    )  # fmt: skip
    batches = [*state.about.get("batches", []), numbers | {"num_groups": len(state)}]
    about = {"gsmerge": __version__, "options": _lasting(told), "batches": batches}
    return replace(state, about=about), done


def _check(state: OnlineState | None, scene: PixelScene | UnalignedScene, options: CompactOptions, most: int) -> None:
    """Refuse what no state can have; ``most``: children of a group."""
    for name in options.whole_only:
        raise UsageError(f"{name}: goes with a whole scene, not with views that come one after the other; use compact")
    if options.fit.fit == "full":
        raise UsageError(
            "fit full: goes with all photos together; expected color or none, and the full fit at decoding"
        )
    if options.decode.count > most:
        raise UsageError(f"max k: expected at least {options.decode.count}, which is k, got {most}")
    degree = scene.gaussians.sh_degree
    if state is not None and degree != state.sh_degree:
        have = state.sh_degree
        raise UsageError(f"expected Gaussians with harmonics of degree {have} as the state's, got degree {degree}")


def _with_photos(
    state: OnlineState,
    seen: tuple[Shots, np.ndarray],
    options: CompactOptions,
    online: OnlineOptions,
    log: RunLog,
) -> OnlineState:
    """The state after its newest photos were looked at, with some of them among those that are kept."""
    parts, (shots, places) = state.parts, seen
    if options.fit.fit == "color":
        with log.stage("fit"):
            parts, report = solve_colors(parts, shots, options.fit, options.seed)
            log.choices["fit"] = asdict(report)
    replay = kept_photos(state.replay, shots, places, len(state.cameras), online.replay)
    return replace(state, parts=parts, replay=replay)


def _lasting(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options without what depends on the machine."""
    return {name: value for name, value in options.items() if name != "threads"}


def _shots(state: OnlineState | None, prepared: PreparedScene) -> Shots:
    """Photos of the batch, or what stands in for them, at the size of the state's views."""
    scene = prepared.scene
    size = scene.cameras if state is None else state.cameras
    return shots_at(scene_pictures(scene), scene.cameras, size.width, size.height)


def _uncovered(
    parts: Parts, batch: MergedViews, shots: Shots, scene: PixelScene | UnalignedScene, online: OnlineOptions
) -> torch.Tensor:
    """Rows of the batch's groups that show something which the groups in view do not show as well."""
    features, members = batch.features, batch.members
    if online.tolerance == 0:
        return torch.arange(len(features))
    pictures, size = shots.photos(2), (scene.cameras.height, scene.cameras.width)
    solved = feature_to_gaussians(with_solved(parts).features)
    there = group_errors(features, members, pixel_errors(solved, pictures, *size))
    own = group_errors(features, members, pixel_errors(feature_to_gaussians(features), pictures, *size))
    return torch.from_numpy(np.flatnonzero(there > np.maximum(online.tolerance**2, online.margin**2 * own)))


def _entered(
    state: OnlineState | None,
    new: Parts,
    prepared: PreparedScene,
    seen: tuple[Shots, np.ndarray, torch.Tensor],
    online: OnlineOptions,
) -> tuple[OnlineState, dict[str, int]]:
    """The state with new groups in it, and how many joined what was there and how many nothing shows.

    ``seen`` are the batch's photos, which of all views they show, and the rows of the state's groups in their view.
    """
    options, scene, (shots, places, rows) = prepared.options, prepared.scene, seen
    if state is None:
        return _begun(new, prepared, online), {}
    found = partners(take(state.parts.features, rows), new.features, options.match)
    joins = found >= 0
    parts = absorb(state.parts, pick(new, torch.nonzero(joins)[:, 0]), rows[found[joins]], state.settings.most)
    alone = pick(new, torch.nonzero(~joins)[:, 0])
    counts = {"num_joined": int(joins.sum())}
    if options.fit.min_contribution > 0 and scene.images is not None:
        beside = take(parts.features, rows)
        every = Gaussians.concat([feature_to_gaussians(beside), feature_to_gaussians(alone.features)])
        shows = visible_mask(every, shots.photos(2), options.fit.min_contribution)[len(beside) :]
        counts["num_hidden"] = int((~shows).sum())
        alone = pick(alone, torch.nonzero(shows)[:, 0])
    kept = [one for one in (state.kept, prepared.hidden) if one is not None]
    total = state.settings.num_input + prepared.given.num_gaussians
    settings = replace(state.settings, num_input=total, k=options.decode.k)
    further = shots.cameras[torch.from_numpy(places >= len(state.cameras))]
    return replace(
        state,
        parts=joined([parts, alone]),
        kept=Gaussians.concat(kept) if kept else None,
        cameras=joined_cameras(state.cameras, further),
        settings=settings,
    ), counts


def _begun(new: Parts, prepared: PreparedScene, online: OnlineOptions) -> OnlineState:
    """The state that a first batch makes."""
    options, cameras = prepared.options, prepared.scene.cameras
    settings = StoredSettings(
        num_input=prepared.given.num_gaussians,
        k=options.decode.k,
        most=online.max_k,
        min_opacity=options.decode.min_opacity,
        prune=options.fit.min_contribution if prepared.given.images is not None else 0.0,
        wanted=None,
        places=None,
        knee=0,
    )
    same = resized(cameras, cameras.width, cameras.height)
    return OnlineState(new, prepared.hidden, prepared.frame, same, no_photos(cameras), settings, {})
