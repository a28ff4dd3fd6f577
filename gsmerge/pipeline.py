"""The story of a run: scene -> groups -> feature gaussians -> merged -> refined -> decoded -> fitted.

:func:`compact` prepares the scene, chooses how many Gaussians, builds, and scores; :func:`build` is every arrow by its
name, whose first half, :func:`merge_views`, encoding and views in batches share. A baseline takes the place of the
arrows alone: preparing, scores and report stay the same.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from gsmerge.baselines import choose_baseline
from gsmerge.gpu import choose_backend
from gsmerge.io import load_scene
from gsmerge.io.cameras.moves import describe_moves, list_moves
from gsmerge.moments import Members, feature_to_gaussians
from gsmerge.options import CompactOptions
from gsmerge.render.photos import NEAR, scene_photos
from gsmerge.report import CompactReport, CompactResult
from gsmerge.runtime.memory import peak_memory
from gsmerge.runtime.record import (
    STAGES,
    Progress,
    choose,
    current_record,
    note,
    record_part,
    record_run,
    report_progress,
    stage,
)
from gsmerge.runtime.threads import use_threads
from gsmerge.search import Build, choose_count, level_counts, search_quality
from gsmerge.stages.agreement import weaken_contradicted
from gsmerge.stages.assign import assign_members
from gsmerge.stages.backing import encode_backing
from gsmerge.stages.choose_merge import choose_merge, choose_start, close_holes
from gsmerge.stages.clean import clean, make_clean
from gsmerge.stages.decode import MIXED, decode_merged
from gsmerge.stages.encode import encode
from gsmerge.stages.fit import FitBackend, Fitted, fit, fit_photos, record_fit, report_steps, run_on
from gsmerge.stages.group import segment_scene
from gsmerge.stages.match import match
from gsmerge.stages.merge import MergedViews, merge, refine
from gsmerge.stages.prepare import PreparedScene, prepare, scene_depth
from gsmerge.stages.segment import scene_saliency
from gsmerge.types import Cameras, FeatureGaussians, Gaussians, PixelScene, Segmentation, UnalignedScene

if TYPE_CHECKING:
    from gsmerge.networks.apply import NetworkContext


def compact(
    scene: PixelScene | UnalignedScene | str | os.PathLike[str],
    options: CompactOptions | None = None,
    *,
    progress: Progress | None = None,
    **settings: Any,
) -> CompactResult:
    """Replace a scene by a compact one that renders at least as well from new viewpoints.

    Args:
        scene: One Gaussian per pixel and view, see :func:`gsmerge.read_scene`; or Gaussians that belong to no pixels,
            which are given to the superpixels by what they add to the views. Tensors give tensors on their device. A
            path is read by :func:`gsmerge.read_scene` with its defaults.
        options: Settings of all stages; None: the defaults.
        progress: Called with (stage, done, total) as each stage begins, done and total in stages, and from within
            the longer ones with ("fit: ...", step, steps).
        **settings: Single settings by name, on top of ``options``: ``compact(scene, k=2, superpixels="1%")``.

    Returns:
        The Gaussians and a report; further levels of detail if they were asked for.

    Raises:
        SceneError: If a path is given that cannot be read.
        ValueError: If a setting is unknown or out of range, or asks for what the scene does not have.
    """
    read_notes: tuple[str, ...] = ()
    if isinstance(scene, str | os.PathLike):
        load = load_scene(scene)
        scene, read_notes = load.scene, load.notes
    options = (options or CompactOptions()).with_settings(settings).with_auto_steps()
    device = scene.gaussians.device
    scene = scene.numpy()
    with use_threads(options.threads), record_run(progress):
        baseline, notes = choose_baseline(options, scene)
        backend, problem = choose_backend(options.fit.device, scene.num_gaussians)
        options = replace(options, fit=replace(options.fit, device=backend.device))
        for text in (*read_notes, *notes, *([] if problem is None else [problem])):
            note(text)
        prepared = prepare(scene, options)
        make: Build = build if baseline is None else baseline.build
        if prepared.options.clean.asked:
            prepared, make = clean_up(prepared, make)
        if options.budget.target_psnr is not None:
            result, cameras = search_quality(prepared, make, score)
        else:
            fitted = make(prepared, choose_count(prepared, build))
            result, cameras = score(fitted, prepared), fitted.cameras
        coarser, placed = [], prepared.with_cameras(cameras)  # the cameras that are written are the finest level's
        for count in level_counts(len(result.gaussians), options.budget.levels, prepared.limits.min_count):
            with record_part():
                coarser.append(score(make(placed, count), placed))
        result = score_input(replace(result, coarser=tuple(coarser)), prepared)
        report_progress("done", len(STAGES), len(STAGES))
    return result if device is None else result.to(device)


def build(prepared: PreparedScene, count: int | None) -> Fitted:
    """Every arrow after the preparation: superpixels to fitted Gaussians, in the canonical frame.

    Args:
        prepared: The scene.
        count: Gaussians in the result; None: as many as ``superpixels`` and K give.
    """
    scene, options = prepared.scene, prepared.options
    gaussians, count, exact, analytic = begin(prepared, count)
    if scene.images is None or not options.fit.needs_photos:
        return Fitted(gaussians, scene.cameras, None)
    with stage("fit"):
        photos = fit_photos(scene, options.fit, prepared.photo_views)
        choose(begun_with=len(gaussians))
        gaussians, report = fit(
            gaussians, photos, options.fit, count, options.seed, report_steps, analytic,
            exact=exact, backend=backend_for(prepared),
        )  # fmt: skip
    record_fit(report)
    cameras = scene.cameras
    if report is not None and report.viewmats is not None:
        poses = cameras.viewmats.astype(np.float64)
        poses[list(prepared.photo_views)] = report.viewmats
        cameras = replace(cameras, viewmats=poses)
    return Fitted(gaussians, cameras, report)


def clean_up(prepared: PreparedScene, make: Build) -> tuple[PreparedScene, Build]:
    """The prepared scene without hidden Gaussians that are not wanted, and ``make`` with clean-up of what it makes."""
    options, scene, lost = prepared.options.clean, prepared.scene, 0
    if prepared.hidden is not None:
        kept = clean(prepared.hidden, options, scene, prepared.frame.leave)[0]
        lost = len(prepared.hidden) - len(kept)
        prepared = replace(prepared, hidden=kept)

    def build_clean(prepared: PreparedScene, count: int | None) -> Fitted:
        wanted = None if count is None else count + lost
        return make_clean(lambda asked: make(prepared, asked), wanted, options, scene, prepared.frame.leave)

    return prepared, build_clean


def begin(prepared: PreparedScene, count: int | None) -> tuple[Gaussians, int, bool, Gaussians | None]:
    """The arrows up to decoding; arguments as of :func:`build`.

    Returns:
        Gaussians; the number that the fit may grow to, and whether it is to be met; another start that the fit may
        beat instead, None for none.
    """
    scene, options = prepared.scene, prepared.options
    if prepared.keeps_all(count):  # merging some and splitting others would only blur
        return scene.gaussians, len(scene.gaussians), True, None
    merged = merge_views(prepared, count)
    with stage("decode"):
        gaussians = decode_merged(merged, options.decode, options.encode.rule, grows=options.fit.grows)
    analytic = None
    if merged.networks is not None and options.fit.fit == "full" and scene.images is not None:
        groups = merged.segmentation.groups
        analytic = feature_to_gaussians(encode(scene, merged.members, groups, options.encode))
    return gaussians, merged.segmentation.count, merged.segmentation.exact, analytic


def merge_views(prepared: PreparedScene, count: int | None) -> MergedViews:
    """The arrows from superpixels to Feature Gaussians that are merged across views and refined.

    Where networks compete with the analytic stages (``checkpoint="auto"``) both run, and the better start is kept.
    """
    scene, options = prepared.scene, prepared.options
    with stage("segment"):
        segmentation = segment_scene(prepared, count)
    members = prepared.members
    if members is None:
        with stage("members"):
            members = assign_members(scene, segmentation.groups, options.contribution)
    saliency = scene_saliency(prepared.pictures) if options.decode.k == MIXED else None
    starts = []
    for networks in prepared.candidates(members):
        features, choices = merge_with(networks, prepared, members, segmentation)
        starts.append(MergedViews(features, members, segmentation, networks, choices, saliency=saliency))
    start = starts[0]
    if len(starts) > 1:
        with stage("choose"):
            start = choose_start(starts, scene, options.decode, options.encode.rule)
    choose(**start.choices)
    if start.networks is not None and prepared.checkpoint is not None:
        choose(networks=prepared.checkpoint.facts())
    return start


def merge_with(
    networks: NetworkContext | None, prepared: PreparedScene, members: Members, segmentation: Segmentation
) -> tuple[FeatureGaussians, dict[str, Any]]:
    """Feature Gaussians of superpixels, merged and refined with these networks or with none; what the stages decided.

    What it holds besides the scene is as large as the result, several times: nothing of it outlives this function.
    """
    scene, options = prepared.scene, prepared.options
    robust = None
    with stage("encode"):
        features = encode(scene, members, segmentation.groups, options.encode, networks)
    if prepared.limits.robust and (networks is None or options.robust.robust):  # networks stand in for the choice
        with stage("robust"):
            coarse = encode_backing(scene, members, segmentation.coarse, options.backing, features)
            photos, aligned = scene_photos(scene, 2), isinstance(scene, PixelScene)
            robust = choose_merge(features, coarse, photos, options.robust, leave_out=aligned)
            features = robust.features
    elif networks is None and options.encode.agreement and prepared.limits.share < 1:  # a long fit follows
        features = weaken_contradicted(features, members, scene.cameras)
    with stage("match"):
        matches = match(features, options.match, networks)
        merged = merge(features, matches, networks)
    choices: dict[str, Any] = {"groups": len(features), "clusters": matches.count}
    del features, matches
    if networks is not None:
        with stage("refine"):
            merged = refine(merged, networks)
    if robust is None:
        return merged, choices
    with stage("close"):
        closed = close_holes(merged, replace(robust, features=merged), options.robust)
    return closed.features, choices | closed.choices


def score(fitted: Fitted, prepared: PreparedScene) -> CompactResult:
    """Canonical Gaussians as a result in the world frame, with its report, scored on the input views."""
    gaussians, record = fitted.gaussians, current_record()
    if prepared.hidden is not None:
        gaussians = Gaussians.concat([gaussians, prepared.hidden])
    prepared = prepared.with_cameras(fitted.cameras)
    gaussians, cameras = prepared.frame.leave(gaussians), prepared.final_cameras()
    after = None
    if cameras is not prepared.given.cameras:
        note_moves(prepared, cameras)
        prepared = replace(prepared, given=replace(prepared.given, cameras=cameras))
    if prepared.given.images is not None:
        with stage("score"):
            after = input_psnr(gaussians, prepared)
        choose(scored_views=len(prepared.scored_views()))
    settings = prepared.settings.to_dict() | {"fit_steps": prepared.options.fit.steps}
    counts = prepared.given.num_gaussians, len(gaussians)
    return CompactResult(
        gaussians,
        CompactReport(*counts, record.seconds, None, after, record.choices, record.notes, settings, peak_memory()),
        cameras,
    )


def note_moves(prepared: PreparedScene, cameras: Cameras) -> None:
    """Tell how far each camera was moved."""
    given, cause = prepared.given, "poses are free"
    if prepared.settings.fit.poses == "auto":
        cause = "the photos of some views agree only under other poses"
    depth = scene_depth(prepared.scene) * prepared.frame.unit
    moves = list_moves(given.names, given.cameras.viewmats, cameras.viewmats, depth)
    choose(poses=moves)
    note(f"{cause}: cameras were moved by {describe_moves(moves)}")


def score_input(result: CompactResult, prepared: PreparedScene) -> CompactResult:
    """The result and its further levels, with the PSNR of the input beside their own.

    It comes last, when the kernels are compiled and memory is free again.
    """
    if prepared.given.images is None:
        return result
    with record_part() as own, stage("input"):
        before = input_psnr(prepared.given.file_gaussians, prepared)

    def with_input(one: CompactResult, seconds: dict[str, float], notes: list[str]) -> CompactResult:
        report = replace(one.report, psnr_before=before, peak_memory_bytes=peak_memory())
        report = replace(report, seconds=report.seconds | seconds, notes=[*report.notes, *notes])
        return replace(one, report=report)

    coarser = tuple(with_input(one, {}, []) for one in result.coarser)
    return replace(with_input(result, own.seconds, own.notes), coarser=coarser)


def input_psnr(gaussians: Gaussians, prepared: PreparedScene) -> float:
    """Mean PSNR (dB) of some input photos, see :meth:`PreparedScene.scored_views`, rendered from world-frame Gaussians.

    In a quarter of every photo, or in the whole where a quality was asked for.
    """
    photos, exact = scene_photos(prepared.given), prepared.options.budget.target_psnr is not None
    views, near = prepared.scored_views(), NEAR * prepared.frame.unit

    def score_on(backend: FitBackend[Any]) -> float:
        return backend.photo_psnr(gaussians, photos, views, quarter=not exact, near=near)

    return run_on(backend_for(prepared), "scores", score_on)


def backend_for(prepared: PreparedScene) -> FitBackend[Any]:
    """Choose where the fit and the scores of a prepared scene run."""
    return choose_backend(prepared.options.fit.device, prepared.given.num_gaussians)[0]
