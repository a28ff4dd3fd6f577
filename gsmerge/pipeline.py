"""Compact a scene: scene -> groups -> feature gaussians -> merged -> refined -> decoded -> fitted -> result."""

from __future__ import annotations

from functools import partial
from typing import Any

from gsmerge.baselines import choose_method
from gsmerge.blocks import compact_in_blocks
from gsmerge.io import as_scene
from gsmerge.options import CompactOptions
from gsmerge.plan import Plan, choose_blocks, make_plan
from gsmerge.result import Candidate, CompactResult, make_result, score
from gsmerge.runtime.record import Progress, record_part, record_run
from gsmerge.runtime.threads import use_threads
from gsmerge.search import Build, level_counts, search_count
from gsmerge.stages.assign import assign
from gsmerge.stages.choose_start import choose_start
from gsmerge.stages.clean import clean_to_count
from gsmerge.stages.decode import Decoded, decode_merged, keep_all
from gsmerge.stages.encode import correct, encode, make_context
from gsmerge.stages.fit import Fitted, fit_scene
from gsmerge.stages.match import match
from gsmerge.stages.merge import MergedViews, merge, refine
from gsmerge.stages.prepare import Prepared, prepare
from gsmerge.stages.segment import segment_scene
from gsmerge.types import Scene, StrPath


def compact(
    scene: Scene | StrPath, options: CompactOptions | None = None, *, progress: Progress | None = None, **settings: Any
) -> CompactResult:
    """Replace a scene by a compact one that renders at least as well from new viewpoints.

    Args:
        scene: What :func:`gsmerge.read_scene` returns, or the path that it reads. Tensors give tensors.
        options: Settings of all stages; None: the defaults.
        progress: Called with (stage, done, stages), and from within longer ones with ("fit: ...", step, steps).
        **settings: Single settings by name, on top of ``options``: ``compact(scene, k=2, superpixels="1%")``.

    Raises SceneError for a path that cannot be read, ValueError for a setting that is unknown or out of range.
    """
    options = (options or CompactOptions()).with_settings(settings)
    with use_threads(options.threads), record_run(progress):
        given = as_scene(scene)
        blocks = choose_blocks(given, options)  # 1: one piece
        return compact_in_blocks(given, options, blocks, start) if blocks > 1 else compact_piece(given, options)


def compact_piece(given: Scene, options: CompactOptions) -> CompactResult:
    """Compact a scene as a whole."""
    method = choose_method(options, given, build)  # ours, or a baseline
    prepared = prepare(given.numpy(), options.prepare)  # facts: frame, photos, poses, unseen
    plan = make_plan(prepared, options)  # every "auto" is decided once; options end here
    search = search_count(prepared, plan, build)  # one count, or counts until a quality is met
    for count in search:
        search.add(build_scored(method, prepared, plan, count))
    fixed = prepared.with_cameras(search.best.fitted.cameras), plan.with_fixed_cameras()
    levels = [build_scored(method, *fixed, count) for count in level_counts(len(search.best.gaussians), plan)]
    return make_result(search.best, levels, prepared, plan, search.facts()).to(given.gaussians.device)


@record_part()
def build_scored(method: Build, prepared: Prepared, plan: Plan, count: int | None) -> Candidate:
    """Build the given number of Gaussians, clean them as asked, and score them, with their own record."""
    fitted = clean_to_count(partial(method, prepared, plan), count, plan.clean, prepared)
    return score(count, fitted, prepared, plan)


def build(prepared: Prepared, plan: Plan, count: int | None) -> Fitted:
    """Build ``count`` fitted canonical Gaussians; None: as many as ``superpixels`` and K give."""
    decoded = start(prepared, plan, count)
    return fit_scene(decoded, prepared.scene, prepared.photo_views, plan.fit, plan.seed, plan.backend)


def start(prepared: Prepared, plan: Plan, count: int | None) -> Decoded:
    """Build the canonical Gaussians that a fit starts with."""
    scene, decode = prepared.scene, plan.decode
    kept = keep_all(scene, count)
    return kept or decode_merged(merge_views(prepared, plan, count), scene, decode, grows=plan.fit.grows)


def merge_views(prepared: Prepared, plan: Plan, count: int | None) -> MergedViews:
    """Merge superpixels across views, the half of the pipeline that encoding and views in batches share."""
    scene = prepared.scene
    segmentation = segment_scene(scene, plan.superpixels, count)
    members = assign(scene, segmentation.groups)
    pooled, matches = encode(scene, members, segmentation.groups), None
    starts = list[MergedViews]()
    for networks in plan.networks:
        context = make_context(networks, members, scene.cameras, plan.seed)
        features = correct(pooled, members, scene.cameras, context, weaken=plan.weakens)
        if matches is None:
            matches = match(features, plan.match, context)
        merged = refine(merge(features, matches, context), context)
        unlearned = None if context is None or plan.fit.fit == "none" else pooled
        starts.append(MergedViews(merged, members, segmentation, len(features), context, unlearned))
        if context is not None and (context.options.encoder or plan.match.geometry == "decoded"):
            matches = None  # they are of what networks made of the geometry
    return choose_start(starts, scene, plan.decode, plan.checkpoint)  # of one: that one
