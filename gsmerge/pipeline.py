"""The arrows: scene -> groups -> feature gaussians -> merged -> refined -> decoded -> fitted."""

from __future__ import annotations

from gsmerge.facts.prepare import Prepared
from gsmerge.fit import Fitted, fit_scene
from gsmerge.plan import Plan
from gsmerge.runtime.record import choose
from gsmerge.stages.assign import assign
from gsmerge.stages.decode import decode_merged, keep_all
from gsmerge.stages.encode import correct, encode, make_corrector
from gsmerge.stages.match import match
from gsmerge.stages.merge import MergedViews, merge, refine
from gsmerge.stages.pair_merge import merge_neighbors
from gsmerge.stages.segment import segment_scene
from gsmerge.stages.take_over import take_over
from gsmerge.types import Decoded, Gaussians


def build(prepared: Prepared, plan: Plan, count: int | None, earlier: Gaussians | None = None) -> Fitted:
    """Build and fit ``count`` canonical Gaussians; None: as many as ``superpixels`` and K give.

    ``earlier``: canonical Gaussians of a result of another moment to start from.
    """
    if prepared.alone:  # no view to cut into superpixels, and no photo to fit to
        scene, most = prepared.scene, plan.limits.default if count is None else count
        return Fitted(merge_neighbors(scene.gaussians, most), scene.cameras, None)
    decoded, options = start(prepared, plan, count), plan.fit
    if earlier is not None:
        taken = take_over(earlier, decoded, prepared.scene, prepared.photo_views)
        decoded, options = (decoded, options) if taken is None else (taken, options.continued())
    return fit_scene(decoded, prepared.scene, prepared.photo_views, options, plan.seed)


def start(prepared: Prepared, plan: Plan, count: int | None) -> Decoded:
    """Build the canonical Gaussians that the fit starts from."""
    scene, decode = prepared.scene, plan.decode
    kept = keep_all(scene, count)
    return kept or decode_merged(merge_views(prepared, plan, count), scene, decode, grows=plan.fit.grows)


def merge_views(prepared: Prepared, plan: Plan, count: int | None) -> MergedViews:
    """Merge the superpixels of all views; compacting, encoding and adding views in batches share this part."""
    scene = prepared.scene
    segmentation = segment_scene(scene, plan.superpixels, count)
    members = assign(scene, segmentation.groups, draws=plan.networks is None)
    networks = make_corrector(plan.networks, members, scene.cameras, plan.seed)
    pooled = encode(scene, members, segmentation.groups)
    features = correct(pooled, members, scene.cameras, networks, weaken=plan.weakens)
    merged = refine(merge(features, match(features, plan.match, networks), networks), networks)
    choose(groups=len(features), clusters=len(merged), **plan.network_facts)
    return MergedViews(merged, members, segmentation, len(features), networks)
