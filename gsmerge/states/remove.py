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
from gsmerge.types import Gaussians, Scene

RESTART = "begin another state with the other batches"


def remove(state: State, number: int) -> State:
    """Return a copy of a state of results without a batch, which is counted from 1.

    The copy is the state that the other batches alone would have made, with two exceptions. Pictures keep the size of
    the first batch's pictures, and pictures that ``max_views`` has left out do not come back. UsageError if there is no
    such batch, if it is the only one, or if the state does not record which Gaussians belong to it.
    """
    scene = _check_removable(state, number)
    batches, removed_id = list(state.about["batches"]), number - 1
    owners = {name: owner for owner, batch in enumerate(batches) for name in batch["views"]}  # of equal names the last
    view_ids = [view for view, name in enumerate(scene.names) if owners[name] != removed_id]
    remaining, names = list[dict[str, Any]](), tuple[str, ...]()
    for owner, batch in enumerate(batches):
        if owner != removed_id:  # views get the names that they would have without the removed batch
            stored_names = [scene.names[view] for view in view_ids if owners[scene.names[view]] == owner]
            batch_names = tuple(batch["views"][name] for name in stored_names)
            names = number_names(names, batch_names)
            new_names = names[len(names) - len(batch_names) :]
            remaining.append(dict(batch) | {"views": dict(zip(new_names, batch_names, strict=True))})
    for batch, count in zip(remaining, accumulate(batch["num_new"] for batch in remaining), strict=True):
        batch["num_gaussians"] = count
    num_removed_views = len(scene.names) - len(view_ids)
    for batch in remaining[removed_id:]:
        batch["num_kept"] = max(0, batch["num_kept"] - num_removed_views)
    about = dict(state.about) | {"batches": remaining, "pictures": sorted({batch["pictures"] for batch in remaining})}
    if "comments" in about:
        about["comments"] = list(dict.fromkeys(line for batch in remaining for line in batch.get("comments", ())))
    gaussians = _remove_gaussians(scene.gaussians, batches, removed_id)
    return replace(state, about=about, scene=replace(subset(scene, view_ids), gaussians=gaussians, names=names))


def _check_removable(state: State, number: int) -> Scene:
    """Return the scene of a state; UsageError if the batch with this number, from 1, cannot be removed from it."""
    batches, scene = state.about["batches"], state.scene
    if not 1 <= number <= len(batches):
        lists = "gsmerge inspect or Compactor.batches lists them"
        raise UsageError(f"remove {number}: expected a batch from 1 to {len(batches)}; {lists}")
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
    return scene


def _remove_gaussians(gaussians: Gaussians, batches: Sequence[Mapping[str, Any]], removed_id: int) -> Gaussians:
    """Return the Gaussians of all batches but one, with harmonics up to the highest degree of these batches."""
    start = sum(batch["num_new"] for batch in batches[:removed_id])
    rows = np.delete(np.arange(len(gaussians)), slice(start, start + batches[removed_id]["num_new"]))
    degree = max(batch["sh_degree"] for batch_id, batch in enumerate(batches) if batch_id != removed_id)
    remaining = gaussians[rows]
    return replace(remaining, shN=remaining.shN[:, : (degree + 1) ** 2 - 1])


def _records_batches(batches: Sequence[Mapping[str, Any]], scene: Scene) -> bool:
    """Return whether the reports of batches assign all Gaussians and views of a scene."""
    kinds = {"num_new": int, "num_kept": int, "sh_degree": int, "views": dict, "pictures": str}
    if not all(type(batch.get(name)) is kind for batch in batches for name, kind in kinds.items()):
        return False
    listed = {name for batch in batches for name in batch["views"]}
    return sum(batch["num_new"] for batch in batches) == len(scene.gaussians) and listed >= set(scene.names)
