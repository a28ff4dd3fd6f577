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

# Prepared scene, plan and count -> fitted canonical Gaussians; a count of None: as many as the plan gives
Build = Callable[[Prepared, Plan, int | None], Fitted]


def build(prepared: Prepared, plan: Plan, count: int | None) -> Fitted:
    """Build and fit ``count`` canonical Gaussians; None: as many as ``superpixels`` and K give."""
    start = (decode_pairs if plan.merges_pairs else decode_views)(prepared, plan, count)
    return prune_and_fill(fit(start, prepared, plan), start, prepared, plan)


def decode_pairs(prepared: Prepared, plan: Plan, count: int | None) -> Decoded:
    """Merge neighbours pair by pair into ``count`` Gaussians."""
    return merge_scene(plan.limits.default if count is None else count, plan.power, prepared)


def decode_views(prepared: Prepared, plan: Plan, count: int | None) -> Decoded:
    """Merge the superpixels of all views, and decode them into the Gaussians that a fit starts from."""
    unchanged = keep_all(prepared.scene, count)
    if unchanged is not None:
        return unchanged
    return decode_merged(merge_views(prepared, plan, count), prepared.scene, plan.decode, grows=plan.fit.grows)


def merge_views(prepared: Prepared, plan: Plan, count: int | None) -> MergedViews:
    """Merge the superpixels of all views."""
    features, members, segmentation, networks = encode_views(prepared, plan, count)
    merged = networks.refine(merge(features, match(features, plan.match), networks))
    record_choices(groups=len(features), clusters=len(merged), **plan.network_facts)
    return MergedViews(merged, members, segmentation, len(features), networks)


def encode_views(
    prepared: Prepared, plan: Plan, count: int | None
) -> tuple[FeatureGaussians, Members, Segmentation, Corrector]:
    """Encode the superpixels of all views into Feature Gaussians, to compact a scene or to add views to a state."""
    scene = prepared.scene
    segmentation = segment_scene(scene, plan.superpixels, count)
    members = assign(scene, segmentation.groups, by_contribution=plan.by_contribution)
    networks = make_corrector(plan.networks, members, scene.cameras, plan.seed)
    pooled = encode(scene, members, segmentation.groups)
    return correct(pooled, members, scene.cameras, networks, weaken=plan.weakens), members, segmentation, networks


def fit(start: Decoded, prepared: Prepared, plan: Plan) -> Fitted:
    """Fit Gaussians to the pictures of the views."""
    if start.is_input and prepared.reference.name == RENDERS:  # the pictures show exactly these Gaussians
        return Fitted(start.gaussians, prepared.scene.cameras, None)
    if plan.merges_pairs:
        return fit_around(start, prepared, plan.fit, plan.seed)
    return fit_scene(start, prepared.scene, plan.fit, plan.seed)


def prune_and_fill(fitted: Fitted, start: Decoded, prepared: Prepared, plan: Plan) -> Fitted:
    """Drop the Gaussians that no view sees, and put new ones into gaps between the views in their place.

    Gaps are filled only after a long fit that was accepted, and only if all of the scene counts, not a region of it. A
    plan that fills the budget, or that drops nothing, keeps unseen Gaussians too, and each new Gaussian takes the place
    of one of them. Merged pairs, trials and an unchanged input stay complete.
    """
    scene, is_unchanged = prepared.scene, start.is_input and fitted.report is None
    is_long = plan.fit.grows and fitted.report is not None and fitted.report.accepted
    has_gaps = is_long and scene.empty is None and scene.region is None and prepared.reference.of_views
    if plan.merges_pairs or plan.is_trial or is_unchanged or not (plan.prunes or has_gaps):
        return fitted
    seen, unseen = split_unseen(fitted.gaussians, fitted.cameras)
    added = seen[:0]
    if has_gaps:
        added = fill_between(seen, fitted.cameras, fitted.outside, len(unseen), beyond=plan.fit.beyond)
    if plan.fit.fills or not plan.prunes:
        added = Gaussians.concat([unseen[: len(unseen) - len(added)], added])
    written = Gaussians.concat([seen, added])
    most = start.count if plan.fit.grows else len(start.gaussians)
    if plan.prunes:
        record_choices(pruned=max(0, most - len(written)))
    return replace(fitted, gaussians=written)
