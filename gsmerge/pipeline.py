"""The stages in their order, from a prepared scene to the Gaussians of a result.

scene -> groups -> Feature Gaussians -> merged -> refined -> decoded -> fitted -> pruned -> filled
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from gsmerge.facts.prepare import Prepared
from gsmerge.fit import Fitted, fit_scene
from gsmerge.geometry.pooling import Members
from gsmerge.networks.corrector import Corrector
from gsmerge.photos.row_colors import RENDERS
from gsmerge.plan import Plan
from gsmerge.runtime.record import record_choices
from gsmerge.stages.assign import assign
from gsmerge.stages.decode import decode_merged, keep_all
from gsmerge.stages.encode import correct, encode, make_corrector
from gsmerge.stages.fill import fill_between
from gsmerge.stages.fit_pairs import fit_around, merge_scene
from gsmerge.stages.match import match
from gsmerge.stages.merge import MergedViews, merge
from gsmerge.stages.prune import split_unseen
from gsmerge.stages.segment import segment_scene
from gsmerge.types import Decoded, FeatureGaussians, Gaussians, Segmentation

# A function of a prepared scene, a plan and a count, which returns fitted canonical Gaussians. If the count is None,
# the plan decides it
Build = Callable[[Prepared, Plan, int | None], Fitted]


def build(prepared: Prepared, plan: Plan, count: int | None) -> Fitted:
    """Build and fit ``count`` canonical Gaussians; None: ``superpixels`` and K decide the number."""
    start = (decode_pairs if plan.merges_pairs else decode_views)(prepared, plan, count)
    return prune_and_fill(fit(start, prepared, plan), start, prepared, plan)


def decode_pairs(prepared: Prepared, plan: Plan, count: int | None) -> Decoded:
    """Merge neighbouring Gaussians pair by pair until ``count`` remain; return them as the start of a fit."""
    return merge_scene(plan.limits.default if count is None else count, plan.power, prepared)


def decode_views(prepared: Prepared, plan: Plan, count: int | None) -> Decoded:
    """Merge the superpixels of all views, and decode them into the Gaussians with which a fit starts.

    If the scene has at most ``count`` Gaussians, all are returned unchanged.
    """
    unchanged = keep_all(prepared.scene, count)
    if unchanged is not None:
        return unchanged
    return decode_merged(merge_views(prepared, plan, count), prepared.scene, plan.decode, grows=plan.fit.grows)


def merge_views(prepared: Prepared, plan: Plan, count: int | None) -> MergedViews:
    """Cut all views into superpixels, and merge superpixels of different views that show the same surface."""
    features, members, segmentation, corrector = encode_views(prepared, plan, count)
    merged = corrector.refine(merge(features, match(features, plan.match), corrector))
    record_choices(groups=len(features), clusters=len(merged), **plan.network_facts)
    return MergedViews(merged, members, segmentation, len(features), corrector)


def encode_views(
    prepared: Prepared, plan: Plan, count: int | None
) -> tuple[FeatureGaussians, Members, Segmentation, Corrector]:
    """Encode each superpixel of all views as a Feature Gaussian; also return members, superpixels and networks.

    A run merges the Feature Gaussians; :mod:`gsmerge.states` keeps them in a file to which views can be added.
    """
    scene = prepared.scene
    segmentation = segment_scene(scene, plan.superpixels, count)
    members = assign(scene, segmentation.groups, by_contribution=plan.by_contribution)
    corrector = make_corrector(plan.networks, members, scene.cameras, plan.seed)
    features = encode(scene, members, segmentation.groups)
    return correct(features, members, scene.cameras, corrector, weaken=plan.weakens), members, segmentation, corrector


def fit(start: Decoded, prepared: Prepared, plan: Plan) -> Fitted:
    """Fit Gaussians to the pictures of the views, with the fit that suits the start."""
    if start.is_input and prepared.reference.name == RENDERS:  # the pictures show exactly these Gaussians
        return Fitted(start.gaussians, prepared.scene.cameras, None)
    if plan.merges_pairs:
        return fit_around(start, prepared, plan.fit, plan.seed)
    return fit_scene(start, prepared.scene, plan.fit, plan.seed)


def prune_and_fill(fitted: Fitted, start: Decoded, prepared: Prepared, plan: Plan) -> Fitted:
    """Drop the Gaussians that no view sees, and fill gaps between the views with at most as many new Gaussians.

    Gaps are filled only after a long fit that was accepted, and not if parts of the scene may be empty, as after a
    crop. If the plan has to fill the budget, or drops nothing, only as many unseen Gaussians are dropped as new
    Gaussians are added. Merged pairs, trials and an unchanged input are returned as they are.
    """
    scene, is_unchanged = prepared.scene, start.is_input and fitted.report is None
    is_long = plan.fit.grows and fitted.report is not None and fitted.report.accepted
    fills_gaps = is_long and scene.empty is None and scene.region is None and prepared.reference.of_views
    if plan.merges_pairs or plan.is_trial or is_unchanged or not (plan.prunes or fills_gaps):
        return fitted
    seen, unseen = split_unseen(fitted.gaussians, fitted.cameras)
    added = seen[:0]
    if fills_gaps:
        added = fill_between(seen, fitted.cameras, fitted.outside, len(unseen), beyond=plan.fit.beyond)
    kept_unseen = unseen[: len(unseen) - len(added) if plan.fit.fills or not plan.prunes else 0]
    result = Gaussians.concat([seen, kept_unseen, added])
    max_count = start.count if plan.fit.grows else len(start.gaussians)
    if plan.prunes:
        record_choices(pruned=max(0, max_count - len(result)))
    return replace(fitted, gaussians=result)
