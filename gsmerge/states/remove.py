"""State and number of a batch -> state without that batch."""

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

RESTART = "begin another state with the other batches"


def remove(state: State, number: int) -> State:
    """Return a copy of a state of results without a batch, which is counted from 1.

    The copy is the state that the other batches alone would have made, with two exceptions. Pictures keep the size of
    the first batch's pictures, and pictures that ``max_views`` has left out do not come back. UsageError if there is no
    such batch, if it is the only one, or if the state does not record which Gaussians belong to it.
    """
    batches, scene = list(state.about["batches"]), state.scene
    if not 1 <= number <= len(batches):
        raise UsageError(f"remove {number}: expected a batch from 1 to {len(batches)}; gsmerge inspect lists them")
    if scene is None:
        raise UsageError(f"remove {number}: expected a state of results, found merged Feature Gaussians; {RESTART}")
    if len(batches) == 1:
        raise UsageError(
            f"remove {number}: expected a batch beside another one, found only it; delete the file instead"
        )
    if not _records_batches(batches, scene):
        raise UsageError(
            f"remove {number}: expected a record of each batch's Gaussians, which states before 0.5 lack; {RESTART}"
        )
    removed, place = batches[number - 1], number - 1
    first = sum(batch["num_new"] for batch in batches[:place])
    rows = np.delete(np.arange(len(scene.gaussians)), slice(first, first + removed["num_new"]))
    owners = {name: owner for owner, batch in enumerate(batches) for name in batch["views"]}  # of equal names the last
    kept = [view for view, name in enumerate(scene.names) if owners[name] != place]
    num_higher = (1 + max(batch["sh_degree"] for batch in batches if batch is not removed)) ** 2 - 1
    gaussians = scene.gaussians[rows]
    gaussians = replace(gaussians, shN=gaussians.shN[:, :num_higher])
    remaining, names = list[dict[str, Any]](), tuple[str, ...]()
    for owner, batch in enumerate(batches):
        if owner != place:  # views get the names that they would have without the removed batch
            own = tuple(batch["views"][scene.names[view]] for view in kept if owners[scene.names[view]] == owner)
            names = number_names(names, own)
            remaining.append(dict(batch) | {"views": dict(zip(names[len(names) - len(own) :], own, strict=True))})
    num_views = len(scene.names) - len(kept)
    for batch, count in zip(remaining, accumulate(batch["num_new"] for batch in remaining), strict=True):
        batch["num_gaussians"] = count
    for batch in remaining[place:]:
        batch["num_kept"] = max(0, batch["num_kept"] - num_views)
    about = dict(state.about) | {"batches": remaining, "pictures": sorted({batch["pictures"] for batch in remaining})}
    if "comments" in about:
        about["comments"] = list(dict.fromkeys(line for batch in remaining for line in batch.get("comments", ())))
    return replace(state, about=about, scene=replace(subset(scene, kept), gaussians=gaussians, names=names))


def _records_batches(batches: Sequence[Mapping[str, Any]], scene: Scene) -> bool:
    """Return whether the reports of batches assign all Gaussians and views of a scene."""
    kinds = {"num_new": int, "num_kept": int, "sh_degree": int, "views": dict, "pictures": str}
    if not all(type(batch.get(name)) is kind for batch in batches for name, kind in kinds.items()):
        return False
    listed = {name for batch in batches for name in batch["views"]}
    return sum(batch["num_new"] for batch in batches) == len(scene.gaussians) and listed >= set(scene.names)
