"""The arrows: scene -> groups -> feature gaussians -> merged -> refined -> decoded -> fitted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from gsmerge.facts.holes import fill_between
from gsmerge.facts.prepare import Prepared
from gsmerge.facts.row_colors import RENDERS
from gsmerge.fit import Fitted, fit_scene
from gsmerge.plan import Plan
from gsmerge.raster.photos import scene_photos, score_photos
from gsmerge.runtime.record import choose
from gsmerge.stages.assign import assign
from gsmerge.stages.decode import decode_merged, keep_all
from gsmerge.stages.encode import correct, encode, make_corrector
from gsmerge.stages.match import match
from gsmerge.stages.merge import MergedViews, merge, refine
from gsmerge.stages.pair_merge import merge_neighbors
from gsmerge.stages.segment import segment_scene
from gsmerge.types import Decoded, Gaussians

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
    return replace(fitted, gaussians=fill_between(fitted.gaussians, fitted.cameras, fitted.outside))


def build_from_pairs(prepared: Prepared, plan: Plan, count: int) -> Fitted:
    """Merge neighbours into ``count`` canonical Gaussians, and fit them to renders of the input if these differ."""
    merged = merge_neighbors(prepared.scene.gaussians, count)
    if plan.fit.fit == "none" or shows_input(merged, prepared, plan):
        return Fitted(merged, prepared.scene.cameras, None)
    scene = prepared.scene_around if plan.fit.grows else prepared.scene
    decoded, views, given = Decoded(merged, count, exact=True), range(len(scene)), len(prepared.scene)
    fitted = fit_scene(decoded, scene, views, plan.fit, plan.seed, num_judged=given)
    refused = fitted.report is None or not fitted.report.accepted
    return replace(fitted, gaussians=merged if refused else fitted.gaussians, cameras=prepared.scene.cameras)


def shows_input(gaussians: Gaussians, prepared: Prepared, plan: Plan) -> bool:
    """Return whether canonical Gaussians are so near to renders of the input that a fit is not worth its time."""
    photos, views = scene_photos(prepared.scene), prepared.reference.score_views
    return score_photos(gaussians, photos, views, quarter=True).psnr >= max(NEAR_INPUT, plan.target_psnr or 0.0)


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
