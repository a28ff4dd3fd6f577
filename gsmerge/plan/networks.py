"""Decide which networks correct the stages, and load them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gsmerge.errors import UsageError
from gsmerge.frozen import replace
from gsmerge.method.facts.scene_size import SceneSize
from gsmerge.plan.efforts import EFFORTS
from gsmerge.runtime.record import note
from gsmerge.settings.compact import CHECKPOINTS, OURS, CompactOptions

if TYPE_CHECKING:
    from gsmerge.method.networks.checkpoint import Checkpoint


def cuts_views(options: CompactOptions, size: SceneSize) -> bool:
    """Return whether a run cuts views into superpixels, which networks can correct; baselines use no networks."""
    return options.method == OURS and size.num_views > 0


def choose_networks(options: CompactOptions, size: SceneSize) -> str:
    """Return the name of the checkpoint in the options or, if this name is "auto", "shipped" or "none".

    The shipped networks improve the result if no fit follows, and if the views have photos or pixels. With a fit,
    further steps gain more than networks that take the same time (docs/internals/networks.md).
    """
    if options.checkpoint != "auto":
        return options.checkpoint
    gains_from_networks = options.fit.fit == "none" and not size.rendered
    return "shipped" if gains_from_networks else "none"


def load_networks(options: CompactOptions, size: SceneSize) -> Checkpoint | None:
    """Load the networks that a run uses; None if a run uses no networks.

    Raises SceneError if networks are required and cannot be used, and UsageError if they do not fit the options.
    """
    if not cuts_views(options, size):
        if options.checkpoint not in CHECKPOINTS:  # refuse a damaged file, although nothing would use it
            from gsmerge.reading.checkpoint import load_checkpoint

            load_checkpoint(options.checkpoint)
        return None
    name = choose_networks(options, size)
    if name == "none":  # as in most runs, which then need not import the modules of networks
        return None
    from gsmerge.reading.checkpoint import find_checkpoint

    checkpoint, notes = find_checkpoint(name, required=options.require_checkpoint)
    for text in notes:
        note(text)
    if checkpoint is not None:
        if options.checkpoint == "auto" and not EFFORTS[options.effort].refines:
            checkpoint = replace(checkpoint, networks=checkpoint.networks.heads_alone())
        check_networks(checkpoint, options)
    return checkpoint


def check_networks(checkpoint: Checkpoint, options: CompactOptions) -> None:
    """Raise UsageError if networks do not fit the options."""
    outputs = checkpoint.networks.options.outputs
    if options.recipe == "paper" and outputs != "absolute":
        raise UsageError(
            f"recipe paper: expected networks with absolute outputs, {checkpoint.path} has {outputs} ones;"
            " gsmerge lab train --preset paper makes them"
        )
    most = checkpoint.networks.options.max_children
    count = options.decode.max_k
    if count > most:
        problem = f"k: expected at most {most} with the absolute outputs of {checkpoint.path}"
        raise UsageError(f"{problem}, got {count}")
