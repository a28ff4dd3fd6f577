"""Prepared scene and options -> plan: the work that decisions need, and then the decisions."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from gsmerge.facts.prepare import Prepared
from gsmerge.facts.scene_size import SceneSize
from gsmerge.plan import (
    FilledOptions,
    Plan,
    check_networks,
    check_pictures,
    choose_networks,
    count_unseen,
    cuts_views,
    decide,
    fill_options,
    heads_alone,
)
from gsmerge.runtime.record import note, stage
from gsmerge.settings.compact import CHECKPOINTS, CompactOptions
from gsmerge.stages.assign import merge_unseen
from gsmerge.types import Gaussians

if TYPE_CHECKING:
    from gsmerge.networks.checkpoint import Checkpoint


def make_plan(prepared: Prepared, options: CompactOptions, checkpoint: Checkpoint | None = None) -> Plan:
    """Make all decisions that the options leave open.

    This also loads the networks and merges the Gaussians that no view sees, because decisions need them.
    ``checkpoint``: networks to use instead of those that the options name. Raises UsageError if the scene or the
    networks do not allow what the options ask for.
    """
    check_pictures(prepared, options)
    with stage("prepare"):
        checkpoint = checkpoint or load_networks(options, prepared.size)
        filled = fill_options(prepared, options)
        return decide(prepared, filled, checkpoint, merge_hidden(prepared, filled))


def load_networks(options: CompactOptions, size: SceneSize) -> Checkpoint | None:
    """Load the networks that a run uses; None: the run uses closed formulas alone.

    Raises SceneError if networks are required and cannot be used, UsageError if they do not fit the options.
    """
    if not cuts_views(options, size):
        if options.checkpoint not in CHECKPOINTS:  # refuse a damaged file, although nothing would use it
            from gsmerge.networks.checkpoint import load_checkpoint

            load_checkpoint(options.checkpoint)
        return None
    name = choose_networks(options, size)
    if name == "none":  # as in most runs, which then need not import the modules of networks
        return None
    from gsmerge.networks.checkpoint import find_checkpoint

    checkpoint, notes = find_checkpoint(name, required=options.require_checkpoint)
    for text in notes:
        note(text)
    if checkpoint is not None:
        if heads_alone(options):
            checkpoint = replace(checkpoint, networks=checkpoint.networks.heads_alone())
        check_networks(checkpoint, options)
    return checkpoint


def merge_hidden(prepared: Prepared, filled: FilledOptions) -> Gaussians:
    """Merge the Gaussians that no view sees, so that they keep their share of the result, and clean them up."""
    scene, unseen = prepared.scene, prepared.unseen
    visible = unseen[unseen.opacities >= filled.options.decode.min_opacity]
    count = min(len(visible), count_unseen(prepared, filled))
    if count == 0:
        return unseen[:0]
    merged = merge_unseen(visible, scene, count)
    if filled.clean.asked:
        from gsmerge.stages.clean import clean

        rows, _ = clean(merged, filled.clean, scene.cameras, scene.images, prepared.frame.leave)
        merged = merged[rows]
    return merged
