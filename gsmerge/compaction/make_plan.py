"""Prepared scene and options -> plan: the work that decisions need, and then the decisions."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from gsmerge.facts.prepare import Prepared
from gsmerge.facts.scene_size import SceneSize
from gsmerge.plan import (
    Plan,
    check_networks,
    check_pictures,
    choose_networks,
    cuts_views,
    decide,
    fill_options,
    heads_alone,
)
from gsmerge.runtime.record import note, stage
from gsmerge.settings.compact import CHECKPOINTS, CompactOptions
from gsmerge.stages.fit_pairs import choose_power

if TYPE_CHECKING:
    from gsmerge.networks.checkpoint import Checkpoint


def make_plan(prepared: Prepared, options: CompactOptions, checkpoint: Checkpoint | None = None) -> Plan:
    """Make all decisions that the options leave open.

    This also loads the networks, because decisions need them. ``checkpoint``: networks to use instead of those that the
    options name. Raises UsageError if the scene or the networks do not allow what the options ask for.
    """
    check_pictures(prepared, options)
    with stage("prepare"):
        checkpoint = checkpoint or load_networks(options, prepared.size)
        plan = decide(prepared, fill_options(prepared, options), checkpoint)
        if not plan.merges_pairs:
            return plan
        count = plan.limits.count or plan.limits.default
        return replace(plan, power=choose_power(count, prepared, plan.fit, plan.seed))


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
