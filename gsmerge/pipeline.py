"""The arrows: scene -> groups -> feature gaussians -> merged -> refined -> decoded -> fitted -> pruned -> filled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gsmerge.facts.place_cameras import placed_views
from gsmerge.facts.prepare import Prepared
from gsmerge.facts.row_colors import RENDERS
from gsmerge.fit import Fitted, fit_scene
from gsmerge.plan import Plan
from gsmerge.raster.photos import Photos, scene_photos, score_photos
from gsmerge.runtime.record import choose, note, stage
from gsmerge.stages.assign import assign
from gsmerge.stages.decode import decode_merged, keep_all
from gsmerge.stages.encode import correct, encode, make_corrector
from gsmerge.stages.fill import fill_between
from gsmerge.stages.match import match
from gsmerge.stages.merge import MergedViews, merge
from gsmerge.stages.pair_merge import POWERS, merge_neighbors
from gsmerge.stages.prune import split_unseen
from gsmerge.stages.segment import segment_scene
from gsmerge.types import Decoded, Gaussians

# dB that a fit may lose in a view which it has not seen, by the power: few look at objects from within
TOLERANCES = 0.0, 3.0
NEAR_INPUT = 36.0  # dB from renders of the input, from which on nobody sees what a fit to them gains

Build = Callable[[Prepared, Plan, int | None], Fitted]  # a way to make canonical Gaussians, as many as are asked for


def build(prepared: Prepared, plan: Plan, count: int | None) -> Fitted:
    """Build and fit ``count`` canonical Gaussians; None: as many as ``superpixels`` and K give."""
    if plan.merges_pairs:
        return build_from_pairs(prepared, plan, plan.limits.default if count is None else count)
    decoded = start(prepared, plan, count)
    if decoded.kept and (plan.fit.fit == "none" or prepared.reference.name == RENDERS):  # whose pictures they show
        return Fitted(decoded.gaussians, prepared.scene.cameras, None)
    fitted = fit_scene(decoded, prepared.scene, prepared.reference.fit_views, plan.fit, plan.seed)
    most = decoded.count if plan.fit.grows else len(decoded.gaussians)
    return finish(fitted, prepared, plan, most) if plan.fit.min_contribution > 0 else fitted


def finish(fitted: Fitted, prepared: Prepared, plan: Plan, most: int) -> Fitted:
    """Leave out the Gaussians that nobody sees, and fill what lies between the views with others in their places.

    It is filled after a long fit that was accepted, and where all that the views show is wanted. ``most``: Gaussians
    that there could be.
    """
    seen, unseen = split_unseen(fitted.gaussians, fitted.cameras)
    is_long = plan.fit.grows and fitted.report is not None and fitted.report.accepted
    scene = prepared.scene
    is_whole = scene.empty is None and scene.region is None and prepared.reference.of_views  # placed ones see all
    others = seen[:0]
    if is_long and is_whole:
        others = fill_between(seen, fitted.cameras, fitted.outside, len(unseen), beyond=plan.fit.beyond)
    if plan.fit.fills:
        others = Gaussians.concat([unseen[: len(unseen) - len(others)], others])
    written = Gaussians.concat([seen, others])
    choose(pruned=max(0, most - len(written)))
    return replace(fitted, gaussians=written)


def build_from_pairs(prepared: Prepared, plan: Plan, count: int) -> Fitted:
    """Merge neighbours into ``count`` canonical Gaussians, and fit them to renders of the input if these differ.

    They are merged by each power of their masses; the best is kept, after the fit where views are placed.
    """
    photos, views = scene_photos(prepared.scene), prepared.reference.score_views
    ways = [merge_neighbors(prepared.scene.gaussians, count, power) for power in POWERS]
    scores = [score_photos(way, photos, views, quarter=True).psnr for way in ways]
    best = int(np.argmax(scores))
    unfitted = Fitted(ways[best], prepared.scene.cameras, None)
    if plan.fit.fit == "none":
        return unfitted
    if scores[best] >= max(NEAR_INPUT, plan.target_psnr or 0.0):  # a fit is not worth its time
        note("nothing is fitted: merged Gaussians look as the input")
        return unfitted
    if prepared.reference.placed:
        return fit_placed(prepared, plan, ways, best)
    scene = prepared.scene_around if plan.fit.grows else prepared.scene
    decoded = Decoded(ways[best], count, exact=True)
    fitted = fit_scene(decoded, scene, range(len(scene)), plan.fit, plan.seed, num_judged=len(prepared.scene))
    accepted = fitted.report is not None and fitted.report.accepted
    return replace(fitted, gaussians=fitted.gaussians if accepted else ways[best], cameras=prepared.scene.cameras)


@stage("fit")
def fit_placed(prepared: Prepared, plan: Plan, ways: list[Gaussians], best: int) -> Fitted:
    """Fit each of several ``ways`` to placed views, and return what then shows best what no fit has seen.

    With a note it is returned unfitted where its fit shows that worse, and the ``best`` way where no fit helps.
    """
    scene = prepared.scene_placed(placed_views(plan.fit.steps))
    photos, views = scene_photos(prepared.scene), prepared.reference.score_views
    placed = range(len(prepared.scene), len(scene))
    fits = [
        fit_scene(Decoded(way, len(way), exact=True), scene, placed, plan.fit, plan.seed, num_judged=len(placed))
        for way in ways
    ]
    helped = [fit.report is not None and fit.report.accepted for fit in fits]
    after = [score_each(fit.gaussians, photos, views) for fit in fits]
    if any(helped):
        best = int(np.argmax([scores.mean() for scores in after]))
    gains = after[best] - score_each(ways[best], photos, views)
    if helped[best] and gains.mean() > 0 and gains.min() >= -TOLERANCES[best]:
        return replace(fits[best], cameras=prepared.scene.cameras)
    note("nothing is fitted: a fit to placed views shows others worse; with cameras it is fitted to theirs")
    return Fitted(ways[best], prepared.scene.cameras, None)


def score_each(gaussians: Gaussians, photos: Photos, views: tuple[int, ...]) -> np.ndarray:
    """Return the PSNR of each view."""
    return np.array([score_photos(gaussians, photos, [view]).psnr for view in views])


def start(prepared: Prepared, plan: Plan, count: int | None) -> Decoded:
    """Build the canonical Gaussians that the fit starts from."""
    scene, decode = prepared.scene, plan.decode
    kept = keep_all(scene, count)
    return kept or decode_merged(merge_views(prepared, plan, count), scene, decode, grows=plan.fit.grows)


def merge_views(prepared: Prepared, plan: Plan, count: int | None) -> MergedViews:
    """Merge the superpixels of all views; compacting and adding views to a state share this part."""
    scene = prepared.scene
    segmentation = segment_scene(scene, plan.superpixels, count)
    members = assign(scene, segmentation.groups, by_contribution=plan.by_contribution)
    networks = make_corrector(plan.networks, members, scene.cameras, plan.seed)
    pooled = encode(scene, members, segmentation.groups)
    features = correct(pooled, members, scene.cameras, networks, weaken=plan.weakens)
    merged = networks.refine(merge(features, match(features, plan.match), networks))
    choose(groups=len(features), clusters=len(merged), **plan.network_facts)
    return MergedViews(merged, members, segmentation, len(features), networks)
