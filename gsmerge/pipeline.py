"""The arrows: scene -> groups -> feature gaussians -> merged -> refined -> decoded -> fitted -> pruned -> filled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from gsmerge.facts.prepare import Prepared
from gsmerge.facts.row_colors import RENDERS
from gsmerge.facts.scene_size import SceneSize
from gsmerge.fit import Fitted, fit_scene
from gsmerge.plan import (
    Plan,
    Settled,
    check_networks,
    check_pictures,
    choose_networks,
    count_unseen,
    cuts_views,
    decide,
    heads_alone,
    settle,
)
from gsmerge.runtime.record import choose, note, stage
from gsmerge.settings.compact import CHECKPOINTS, CompactOptions
from gsmerge.stages.assign import assign, merge_unseen
from gsmerge.stages.decode import decode_merged, keep_all
from gsmerge.stages.encode import correct, encode, make_corrector
from gsmerge.stages.fill import fill_between
from gsmerge.stages.fit_pairs import fit_pairs, unfitted
from gsmerge.stages.match import match
from gsmerge.stages.merge import MergedViews, merge
from gsmerge.stages.pair_merge import POWERS, merge_neighbors
from gsmerge.stages.prune import split_unseen
from gsmerge.stages.segment import segment_scene
from gsmerge.types import Decoded, Gaussians

if TYPE_CHECKING:
    from gsmerge.networks.checkpoint import Checkpoint

# Prepared scene, plan and count -> canonical Gaussians, as many as the count; None: as many as the plan gives
Build = Callable[[Prepared, Plan, int | None], Fitted]


def make_plan(prepared: Prepared, options: CompactOptions, checkpoint: Checkpoint | None = None) -> Plan:
    """Make all decisions that the options leave open, and what they need: networks, and merged Gaussians out of sight.

    ``checkpoint``: networks to use instead of those that the options name. Raises UsageError if the scene or the
    networks do not allow what the options ask for.
    """
    check_pictures(prepared, options)
    with stage("prepare"):
        checkpoint = checkpoint or load_networks(options, prepared.size)
        settled = settle(prepared, options)
        return decide(prepared, settled, checkpoint, merge_hidden(prepared, settled))


def load_networks(options: CompactOptions, size: SceneSize) -> Checkpoint | None:
    """Load the networks that a run uses; None: it uses closed formulas alone.

    Raises SceneError if networks are required and cannot be used, UsageError if they do not fit the options.
    """
    from gsmerge.networks.checkpoint import find_checkpoint, load_checkpoint

    if not cuts_views(options, size):
        if options.checkpoint not in CHECKPOINTS:  # a damaged file is refused, although nothing uses it
            load_checkpoint(options.checkpoint)
        return None
    checkpoint, notes = find_checkpoint(choose_networks(options, size), required=options.require_checkpoint)
    for text in notes:
        note(text)
    if checkpoint is not None:
        if heads_alone(options):
            checkpoint = replace(checkpoint, networks=checkpoint.networks.heads_alone())
        check_networks(checkpoint, options)
    return checkpoint


def merge_hidden(prepared: Prepared, settled: Settled) -> Gaussians:
    """Merge the Gaussians that no view sees into their share of the result, and clean them up."""
    scene, unseen = prepared.scene, prepared.unseen
    visible = unseen[unseen.opacities >= settled.options.decode.min_opacity]
    count = min(len(visible), count_unseen(prepared, settled))
    if count == 0:
        return unseen[:0]
    merged = merge_unseen(visible, scene, count)
    if settled.clean.asked:
        from gsmerge.stages.clean import clean

        rows, _ = clean(merged, settled.clean, scene.cameras, scene.images, prepared.frame.leave)
        merged = merged[rows]
    return merged


def build(prepared: Prepared, plan: Plan, count: int | None) -> Fitted:
    """Build and fit ``count`` canonical Gaussians; None: as many as ``superpixels`` and K give."""
    starts = decode_pairs(prepared, plan, count) if plan.merges_pairs else [decode_views(prepared, plan, count)]
    fitted = fit(starts, prepared, plan)
    return prune_and_fill(fitted, starts[0], prepared, plan)


def decode_pairs(prepared: Prepared, plan: Plan, count: int | None) -> list[Decoded]:
    """Merge neighbours pair by pair into ``count`` Gaussians, once for each power of their masses."""
    count = plan.limits.default if count is None else count
    merged = (merge_neighbors(prepared.scene.gaussians, count, power) for power in POWERS)
    return [Decoded(gaussians, count, exact=True) for gaussians in merged]


def decode_views(prepared: Prepared, plan: Plan, count: int | None) -> Decoded:
    """Merge the superpixels of all views, and decode them into the Gaussians that a fit starts from."""
    whole = keep_all(prepared.scene, count)
    return whole or decode_merged(merge_views(prepared, plan, count), prepared.scene, plan.decode, grows=plan.fit.grows)


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


def fit(starts: list[Decoded], prepared: Prepared, plan: Plan) -> Fitted:
    """Fit Gaussians to the pictures of the views; of several ``starts``, return the one with the best result."""
    if plan.merges_pairs:
        return fit_pairs(starts, prepared, plan.fit, plan.seed, plan.target_psnr or 0.0)
    [start] = starts
    if start.is_input and prepared.reference.name == RENDERS:  # the pictures show exactly these Gaussians
        return unfitted(start, prepared)
    return fit_scene(start, prepared.scene, prepared.reference.fit_views, plan.fit, plan.seed)


def prune_and_fill(fitted: Fitted, start: Decoded, prepared: Prepared, plan: Plan) -> Fitted:
    """Drop the Gaussians that nobody sees, and fill what lies between the views with others in their place.

    Gaps are filled after a long fit that was accepted, where the whole scene counts. Merged pairs and an unchanged
    input stay whole.
    """
    is_unchanged = start.is_input and fitted.report is None
    if not plan.prunes or is_unchanged:
        return fitted
    scene = prepared.scene
    seen, unseen = split_unseen(fitted.gaussians, fitted.cameras)
    is_long = plan.fit.grows and fitted.report is not None and fitted.report.accepted
    is_whole = scene.empty is None and scene.region is None and prepared.reference.of_views  # placed views see all
    added = seen[:0]
    if is_long and is_whole:
        added = fill_between(seen, fitted.cameras, fitted.outside, len(unseen), beyond=plan.fit.beyond)
    if plan.fit.fills:  # the budget is used up with what nobody sees
        added = Gaussians.concat([unseen[: len(unseen) - len(added)], added])
    written = Gaussians.concat([seen, added])
    most = start.count if plan.fit.grows else len(start.gaussians)
    choose(pruned=max(0, most - len(written)))
    return replace(fitted, gaussians=written)
