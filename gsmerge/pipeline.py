"""The whole story: scene -> groups -> feature gaussians -> merged -> decoded -> fitted."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import torch

from gsmerge.allocate import split_counts
from gsmerge.backing import encode_backing
from gsmerge.decode import decode
from gsmerge.encode import encode
from gsmerge.fit import fit
from gsmerge.grouping import Grouping, group_scene
from gsmerge.match import match
from gsmerge.memory import peak_memory, release_memory
from gsmerge.merge import merge
from gsmerge.metrics import psnr
from gsmerge.moments import Members
from gsmerge.options import CompactOptions
from gsmerge.photos import Photos, scene_photos
from gsmerge.render import composite, plan_view, prepare
from gsmerge.robust import choose_merge, close_holes
from gsmerge.threads import parallel_map, use_threads
from gsmerge.types import FeatureGaussians, Gaussians, LooseScene, PixelScene
from gsmerge.unaligned import loose_count, make_ready, members_of

Progress = Callable[[str, int, int], None]
ONE_AT_A_TIME = 400_000  # Gaussians; the plan of a view is as large as they are, so threads share one view instead
NEAR = 0.01  # near plane, in canonical units
RELEASED = ("encode", "robust", "fit")  # stages that leave much behind that was freed in other threads
STAGES = ("prepare", "segment", "members", "encode", "robust", "match", "decode", "fit", "score")


@dataclass(frozen=True)
class CompactReport:
    """What a run did.

    Args:
        num_input: Gaussians in the scene.
        num_output: Gaussians in the result.
        seconds: Wall time of each stage.
        psnr_before: Mean PSNR (dB) of the input views rendered from the input; None without photos.
        psnr_after: The same from the result.
        choices: What the stages decided (merge, scores, clusters, fit).
        notes: Things worth telling, one sentence each.
        options: All settings by flat name.
        peak_memory_bytes: Largest resident memory of the process so far.
    """

    num_input: int
    num_output: int
    seconds: dict[str, float]
    psnr_before: float | None
    psnr_after: float | None
    choices: dict[str, Any]
    notes: list[str]
    options: dict[str, Any]
    peak_memory_bytes: int


@dataclass(frozen=True)
class CompactResult:
    """The compact Gaussians, in the scene's own world frame, and the report."""

    gaussians: Gaussians
    report: CompactReport


@dataclass
class _Run:
    """Clock and notebook of one run."""

    progress: Progress | None
    seconds: dict[str, float] = field(default_factory=dict)
    choices: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def fit_progress(self, step: int, steps: int, photos: float, held_out: float) -> None:
        if self.progress:
            self.progress(f"fit: photos {photos:.1f} dB, held out {held_out:.1f} dB", step, steps)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        if self.progress:
            self.progress(name, STAGES.index(name), len(STAGES))
        start = time.perf_counter()
        yield
        if name in RELEASED:
            release_memory()
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def compact(
    scene: PixelScene | LooseScene,
    options: CompactOptions | None = None,
    *,
    progress: Progress | None = None,
    **settings: Any,
) -> CompactResult:
    """Replace a scene by a compact one that renders at least as well from new viewpoints.

    Args:
        scene: One Gaussian per pixel and view, see :func:`gsmerge.read_scene`; or Gaussians in no order, which are
            given to the superpixels by what they add to the views.
        options: Settings of all stages; None: the defaults.
        progress: Called with (stage, done, total) as each stage begins, done and total in stages, and from within
            the fit with ("fit: ...", step, steps).
        **settings: Single settings by name, on top of ``options``: ``compact(scene, k=2, density=0.01)``.

    Returns:
        The Gaussians and a report.

    Raises:
        ValueError: If a setting is unknown or out of range, or no Gaussian is finite.
    """
    settled = (options or CompactOptions()).with_settings(settings)
    run = _Run(progress)
    with use_threads(settled.threads), torch.no_grad():
        with run.stage("prepare"):
            ready = make_ready(scene, settled)
            canonical, frame, options, kept = ready.scene, ready.frame, ready.options, ready.kept
            run.notes += ready.notes
            del ready
        with run.stage("segment"):
            grouping = group_scene(canonical, options)
        with run.stage("members"):
            members = members_of(canonical, grouping.groups, options)
        features = _merged_features(canonical, members, grouping, options, run)
        with run.stage("decode"):
            children = _filled(features, members, grouping, options)
            gaussians = decode(features, members, options.decode, children, options.encode.rule)
        del features, members
        if canonical.images is not None:
            with run.stage("fit"):
                gaussians = _fitted(gaussians, canonical, grouping, options, run)
        del canonical
        gaussians = frame.leave(gaussians if kept is None else Gaussians.concat([gaussians, kept]))
        before = after = None
        if scene.images is not None:
            with run.stage("score"):
                photos, near = scene_photos(scene), NEAR * frame.unit
                before, after = input_psnr(scene.gaussians, photos, near), input_psnr(gaussians, photos, near)
    if progress:
        progress("done", len(STAGES), len(STAGES))
    counts = len(scene.gaussians), len(gaussians)
    report = CompactReport(
        *counts, run.seconds, before, after, run.choices, run.notes, settled.to_dict(), peak_memory()
    )
    return CompactResult(gaussians, report)


def _merged_features(
    scene: PixelScene | LooseScene, members: Members, grouping: Grouping, options: CompactOptions, run: _Run
) -> FeatureGaussians:
    """One Feature Gaussian per superpixel, the merge that the photos prefer, and merging across views."""
    with run.stage("encode"):
        features = encode(scene, members, grouping.groups, options.encode)
    if not grouping.robust:
        with run.stage("match"):
            return _matched(features, options, run)
    with run.stage("robust"):
        coarse = grouping.coarse
        backing = encode_backing(scene, members, coarse, options.backing) if coarse is not None else None
        photos = scene_photos(scene, 2)
        aligned = isinstance(scene, PixelScene)
        features, choice = choose_merge(features, backing, photos, options.robust, left_out=aligned)
        run.choices["merge"], run.choices["merge_scores"] = choice.name, choice.scores
    with run.stage("match"):
        features, choice = close_holes(_matched(features, options, run), backing, photos, options.robust)
        run.choices["closed"] = choice.name
        return features


def _filled(
    features: FeatureGaussians, members: Members, grouping: Grouping, options: CompactOptions
) -> np.ndarray | None:
    """Children of each group where a number of Gaussians is to be met and no fit grows to it; None: K everywhere."""
    if grouping.exact and not options.fit.grows:
        wanted: int | None = grouping.wanted
    else:
        wanted = loose_count(features, members, grouping, options)
    return None if wanted is None else split_counts(features, members, max(0, wanted - len(features)))


def _matched(features: FeatureGaussians, options: CompactOptions, run: _Run) -> FeatureGaussians:
    """Merged across views."""
    matches = match(features, options.match)
    run.choices["groups"], run.choices["clusters"] = len(features), matches.count
    return merge(features, matches)


def _fitted(
    gaussians: Gaussians, scene: PixelScene | LooseScene, grouping: Grouping, options: CompactOptions, run: _Run
) -> Gaussians:
    """Gaussians that no photo shows left out, the rest fitted to the photos."""
    photos = scene_photos(scene), scene_photos(scene, 2)
    run.choices["begun_with"] = len(gaussians)
    # where nothing grows to the number asked for, nothing may fall below it either
    settings = replace(options.fit, prune=0.0) if grouping.exact and not options.fit.grows else options.fit
    gaussians, report = fit(gaussians, photos, settings, grouping.wanted, options.seed, run.fit_progress)
    if report:
        run.choices["fit"] = asdict(report)
        if not report.accepted:
            run.notes.append("the fit was not accepted: held-out parts of the photos did not get better")
    return gaussians


def input_psnr(gaussians: Gaussians, photos: Photos, near: float) -> float:
    """Mean PSNR (dB) of the photos rendered from some Gaussians beyond the near plane."""
    splats = prepare(gaussians)

    def one_view(view: int) -> float:
        plan = plan_view(splats, **photos.camera(view), near=near)
        return psnr(np.clip(composite(plan)[0], 0, 1), photos.images[view])

    if len(gaussians) > ONE_AT_A_TIME:
        return float(np.mean([one_view(view) for view in range(len(photos))]))
    return float(np.mean(parallel_map(one_view, range(len(photos)))))


__all__ = ["CompactOptions", "CompactReport", "CompactResult", "compact"]
