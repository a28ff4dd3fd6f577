"""The pipeline of rows that are pixels, or that photos show: the stages in their order.

scene -> groups -> Feature Gaussians -> merged -> refined -> decoded -> fitted -> pruned -> filled
"""

from __future__ import annotations

from dataclasses import replace

from gsmerge.method.facts.pictures import RENDERS
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.fit import Fitted, fit_scene
from gsmerge.method.geometry.pooling import Members
from gsmerge.method.networks.corrector import ANALYTIC, Corrector
from gsmerge.method.pipelines.plan import MergePlan, Pipeline, Plan
from gsmerge.method.stages.assign import assign
from gsmerge.method.stages.decode import decode_merged
from gsmerge.method.stages.encode import correct, encode
from gsmerge.method.stages.fill import fill_between
from gsmerge.method.stages.match import match
from gsmerge.method.stages.merge import MergedViews, merge
from gsmerge.method.stages.prune import split_unseen
from gsmerge.method.stages.segment import segment_scene
from gsmerge.runtime.record import record_choices
from gsmerge.types import Decoded, FeatureGaussians, Gaussians, Groups, PicturedScene


def build_from_pixels(prepared: Prepared, plan: Plan, count: int | None) -> Fitted:
    """Build and fit ``count`` canonical Gaussians; None: ``superpixels`` and K decide the number.

    After the fit, the Gaussians that no view sees are dropped, and gaps between the views are filled with at most as
    many new Gaussians. Gaps are filled only after a long fit that was accepted, and not if parts of the scene may be
    empty, as after a crop. If the plan has to fill the budget, or drops nothing, only as many unseen Gaussians are
    dropped as new Gaussians are added. Trials and an unchanged input are returned as they are.
    """
    scene = prepared.scene
    start = merge_views(prepared, plan, count)
    if start.is_input and (plan.fit.fit == "none" or prepared.reference.name == RENDERS):
        return Fitted(start.gaussians, scene.cameras, None)  # the pictures show exactly these Gaussians
    fitted = fit_scene(start, scene, plan.fit, plan.seed)
    is_long = plan.fit.grows and fitted.report is not None and fitted.report.accepted
    fills_gaps = is_long and scene.empty is None and scene.region is None and prepared.reference.of_views
    if plan.is_trial or not (plan.prunes or fills_gaps):
        return fitted
    seen, unseen = split_unseen(fitted.gaussians, fitted.cameras)
    added = seen[:0]
    if fills_gaps:
        added = fill_between(seen, fitted.cameras, fitted.outside, len(unseen), beyond=plan.fit.beyond)
    num_unseen = len(unseen) - len(added) if plan.fit.fills or not plan.prunes else 0
    gaussians = Gaussians.concat([seen, unseen[:num_unseen], added])
    if plan.prunes:
        most = start.count if plan.fit.grows else len(start.gaussians)
        record_choices(pruned=max(0, most - len(gaussians)))
    return replace(fitted, gaussians=gaussians)


PIXEL_ROWS = Pipeline("pixel rows", build_from_pixels)


def merge_views(prepared: Prepared, plan: Plan, count: int | None) -> Decoded:
    """Cut all views into superpixels, merge superpixels that show the same surface, and decode them for a fit.

    If the scene has at most ``count`` Gaussians, all are returned unchanged.
    """
    scene = prepared.scene
    if count is not None and count >= len(scene.gaussians):
        return Decoded(scene.gaussians, len(scene.gaussians), exact=True, is_input=True)
    segmentation = segment_scene(scene, plan.merge.superpixels, plan.count.limits, count)
    features, members, networks = encode_groups(scene, segmentation.groups, plan.merge, plan.seed)
    merged = networks.refine(merge(features, match(features, plan.merge.match), networks))
    record_choices(groups=len(features), clusters=len(merged), **plan.merge.network_facts)
    views = MergedViews(merged, members, segmentation, len(features), networks)
    return decode_merged(views, scene, plan.merge.decode, grows=plan.fit.grows)


def encode_groups(
    scene: PicturedScene, groups: Groups, plan: MergePlan, seed: int
) -> tuple[FeatureGaussians, Members, Corrector]:
    """Encode each superpixel of all views as a Feature Gaussian; also return its members, and the networks."""
    members = assign(scene, groups, by_contribution=plan.by_contribution)
    networks: Corrector = ANALYTIC  # changes nothing
    if plan.networks is not None:
        from gsmerge.method.networks.apply import NetworkContext

        networks = NetworkContext(plan.networks, members, scene.cameras, seed)
    features = encode(scene, members, groups)
    return correct(features, members, scene.cameras, networks, weaken=plan.weakens), members, networks
