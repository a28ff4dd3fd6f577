"""What baselines share: the Gaussians of the file, shares of views, the most important, one for each group."""

from __future__ import annotations

from typing import Literal

import numpy as np

from gsmerge.facts.prepare import Prepared
from gsmerge.runtime.record import stage
from gsmerge.stages.assign import assign
from gsmerge.stages.decode import DecodeOptions, decode
from gsmerge.stages.encode import encode
from gsmerge.types import Gaussians, Groups, Scene


def own_gaussians(scene: Scene) -> Gaussians:
    """Return the Gaussians of the file, without rows that only stand in for missing or broken Gaussians."""
    if scene.aligned and not bool(scene.stored.all()):
        return scene.gaussians[scene.stored.reshape(-1)]
    return scene.gaussians


def view_shares(count: int, num_views: int, max_per_view: int) -> list[int]:
    """Divide a number evenly among the views, at most ``max_per_view`` each; the first views get the rest."""
    return [min(max_per_view, count // num_views + (view < count % num_views)) for view in range(num_views)]


def most_important(importance: np.ndarray, count: int) -> np.ndarray:
    """Find the rising indices of the ``count`` most important Gaussians, or all; the first of equals.

    ``importance [n]`` is for instance the summed blending weight over all photos. A ValueError if ``count`` is below 0.
    """
    if count < 0:
        raise ValueError(f"count: expected at least 0, got {count}")
    order = np.argsort(-np.nan_to_num(importance, nan=-np.inf, neginf=-np.inf), kind="stable")
    return np.sort(order[:count])


def merge_groups(prepared: Prepared, groups: Groups, rule: Literal["depth", "paper"] = "depth") -> Gaussians:
    """Make one Gaussian for each group, without matching across views; empty groups are left out."""
    members = assign(prepared.scene, groups)
    features = encode(prepared.scene, members, groups, rule=rule)
    with stage("decode"):
        return decode(features, members, DecodeOptions(min_opacity=0.0))
