"""The arrows: scene -> groups -> feature gaussians -> merged -> refined -> decoded -> fitted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gsmerge.facts.holes import fill_between
from gsmerge.facts.place_cameras import placed_views
from gsmerge.facts.prepare import Prepared
from gsmerge.facts.row_colors import RENDERS
from gsmerge.fit import Fitted, fit_scene
from gsmerge.plan import Plan
from gsmerge.raster.photos import scene_photos, score_photos
from gsmerge.runtime.record import choose, note
from gsmerge.stages.assign import assign
from gsmerge.stages.decode import decode_merged, keep_all
from gsmerge.stages.encode import correct, encode, make_corrector
from gsmerge.stages.match import match
from gsmerge.stages.merge import MergedViews, merge, refine
from gsmerge.stages.pair_merge import POWERS, merge_neighbors
from gsmerge.stages.segment import segment_scene
from gsmerge.types import Decoded, Gaussians

# dB that a fit may lose in a view which it has not seen, by the power that was best: few look at objects from within
TOLERANCES = dict(zip(POWERS, (0.0, 3.0), strict=True))
NEAR_INPUT = 36.0  # dB from renders of the input, from which on nobody sees what a fit to them gains

Build = Callable[[Prepared, Plan, int | None], Fitted]  # a way to make canonical Gaussians, as many as are asked for


def build(prepared: Prepared, plan: Plan, count: int | None) -> Fitted:
    """Build and fit ``count`` canonical Gaussians; None: as many as ``superpixels`` and K give."""
    if plan.merges_pairs:
        return build_from_pairs(prepared, plan, plan.limits.default if count is None else count)
    decoded = start(prepared, plan, count)
    if decoded.gaussians is prepared.scene.gaussians and prepared.reference.name == RENDERS:
        return Fitted(decoded.gaussians, prepared.scene.cameras, None)  # they show these pictures as they are
    fitted = fit_scene(decoded, prepared.scene, prepared.reference.fit_views, plan.fit, plan.seed)
    long = plan.fit.grows and fitted.report is not None and fitted.report.accepted
    whole = prepared.scene.empty is None
    if not long or not whole or not prepared.reference.of_views:  # what placed views see is all there is
        return fitted
    return replace(fitted, gaussians=fill_between(fitted.gaussians, fitted.cameras))


def build_from_pairs(prepared: Prepared, plan: Plan, count: int) -> Fitted:
    """Merge neighbours into ``count`` canonical Gaussians, and fit them to renders of the input if these differ.

    A fit to views that are placed is refused where it shows worse what it has not seen, with a note.
    """
    merged, psnr, power = merge_shown(prepared, count)
    if plan.fit.fit == "none":
        return Fitted(merged, prepared.scene.cameras, None)
    if psnr >= max(NEAR_INPUT, plan.target_psnr or 0.0):  # a fit is not worth its time
        note("nothing is fitted: merged Gaussians look as the input")
        return Fitted(merged, prepared.scene.cameras, None)
    placed, given = prepared.reference.placed, len(prepared.scene)
    if placed:
        scene = prepared.scene_placed(placed_views(plan.fit.steps))
    else:
        scene = prepared.scene_around if plan.fit.grows else prepared.scene
    decoded, views = Decoded(merged, count, exact=True), range(given if placed else 0, len(scene))
    fitted = fit_scene(decoded, scene, views, plan.fit, plan.seed, num_judged=given)
    refused = fitted.report is None or not fitted.report.accepted
    if placed and not refused and not shows_as_well(fitted.gaussians, merged, prepared, TOLERANCES[power]):
        note("nothing is fitted: a fit to placed views shows others worse; with cameras it is fitted to theirs")
        refused = True
    return replace(fitted, gaussians=merged if refused else fitted.gaussians, cameras=prepared.scene.cameras)


def shows_as_well(after: Gaussians, before: Gaussians, prepared: Prepared, tolerance: float) -> bool:
    """Return whether renders of the input, which no fit has seen, are shown better after a fit, each one nearly."""
    photos = scene_photos(prepared.scene)
    views = prepared.reference.score_views
    now, then = (np.array([score_photos(g, photos, [view]).psnr for view in views]) for g in (after, before))
    gains = now - then
    return bool(gains.mean() > 0 and gains.min() >= -tolerance)


def merge_shown(prepared: Prepared, count: int) -> tuple[Gaussians, float, float]:
    """Merge neighbours by each power of their masses; return what is nearest to the renders, its dB and its power."""
    photos, views = scene_photos(prepared.scene), prepared.reference.score_views
    ways = [merge_neighbors(prepared.scene.gaussians, count, power) for power in POWERS]
    scores = [score_photos(way, photos, views, quarter=True).psnr for way in ways]
    best = int(np.argmax(scores))
    return ways[best], scores[best], POWERS[best]


def start(prepared: Prepared, plan: Plan, count: int | None) -> Decoded:
    """Build the canonical Gaussians that the fit starts from."""
    scene, decode = prepared.scene, plan.decode
    kept = keep_all(scene, count)
    return kept or decode_merged(merge_views(prepared, plan, count), scene, decode, grows=plan.fit.grows)


def merge_views(prepared: Prepared, plan: Plan, count: int | None) -> MergedViews:
    """Merge the superpixels of all views; compacting and adding views to a state share this part."""
    scene = prepared.scene
    segmentation = segment_scene(scene, plan.superpixels, count)
    members = assign(scene, segmentation.groups, draws=plan.draws)
    networks = make_corrector(plan.networks, members, scene.cameras, plan.seed)
    pooled = encode(scene, members, segmentation.groups)
    features = correct(pooled, members, scene.cameras, networks, weaken=plan.weakens)
    merged = refine(merge(features, match(features, plan.match), networks), networks)
    choose(groups=len(features), clusters=len(merged), **plan.network_facts)
    return MergedViews(merged, members, segmentation, len(features), networks)
