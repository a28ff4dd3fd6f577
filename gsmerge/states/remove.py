"""State and the number of a batch -> state without that batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any

import numpy as np

from gsmerge.errors import UsageError
from gsmerge.facts.views import subset
from gsmerge.states.extend import number_names
from gsmerge.states.state_file import State
from gsmerge.types import Scene

AGAIN = "begin another state with the other batches"


def remove(state: State, number: int) -> State:
    """Take a batch, counted from 1, out of a state of results, which is not changed.

    What is left is what the other batches alone would have made, but for two things: pictures stay at the size of the
    first batch's, and those that ``max_views`` left out do not come back. UsageError if there is no such batch, it is
    the only one, or the state does not say which Gaussians are its own.
    """
    batches, scene = list(state.about["batches"]), state.scene
    if not 1 <= number <= len(batches):
        raise UsageError(f"remove {number}: expected a batch from 1 to {len(batches)}, which inspect lists")
    if scene is None:
        raise UsageError(f"remove {number}: expected a state of results, found Feature Gaussians, merged; {AGAIN}")
    if len(batches) == 1:
        raise UsageError(f"remove {number}: expected a batch beside it, found none; delete the file, or begin another")
    if not _tells_batches(batches, scene):
        raise UsageError(f"remove {number}: the state does not say what is whose, as those before 0.5 do not; {AGAIN}")
    gone, place = batches[number - 1], number - 1
    first = sum(batch["num_new"] for batch in batches[:place])
    rows = np.delete(np.arange(len(scene.gaussians)), slice(first, first + gone["num_new"]))
    owners = {name: owner for owner, batch in enumerate(batches) for name in batch["views"]}  # the last that took it
    kept = [view for view, name in enumerate(scene.names) if owners[name] != place]
    num_higher = (1 + max(batch["sh_degree"] for batch in batches if batch is not gone)) ** 2 - 1
    gaussians = scene.gaussians[rows]
    gaussians = replace(gaussians, shN=gaussians.shN[:, :num_higher])
    left, names = list[dict[str, Any]](), tuple[str, ...]()
    for owner, batch in enumerate(batches):
        if owner != place:  # views get their names as if the other batches had come alone
            own = tuple(batch["views"][scene.names[view]] for view in kept if owners[scene.names[view]] == owner)
            names = number_names(names, own)
            left.append(dict(batch) | {"views": dict(zip(names[len(names) - len(own) :], own, strict=True))})
    num_views = len(scene.names) - len(kept)
    for batch, count in zip(left, accumulate(batch["num_new"] for batch in left), strict=True):
        batch["num_gaussians"] = count
    for batch in left[place:]:
        batch["num_kept"] = max(0, batch["num_kept"] - num_views)
    about = dict(state.about) | {"batches": left, "pictures": sorted({batch["pictures"] for batch in left})}
    if "comments" in about:
        about["comments"] = list(dict.fromkeys(line for batch in left for line in batch.get("comments", ())))
    return replace(state, about=about, scene=replace(subset(scene, kept), gaussians=gaussians, names=names))


def _tells_batches(batches: Sequence[Mapping[str, Any]], scene: Scene) -> bool:
    """Return whether batches say which Gaussians and views of a scene are whose."""
    kinds = {"num_new": int, "num_kept": int, "sh_degree": int, "views": dict, "pictures": str}
    if not all(type(batch.get(name)) is kind for batch in batches for name, kind in kinds.items()):
        return False
    listed = {name for batch in batches for name in batch["views"]}
    return sum(batch["num_new"] for batch in batches) == len(scene.gaussians) and listed >= set(scene.names)
