"""Interface of baselines (other methods): a name, needs, settings in use, and a function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gsmerge.plan import Plan
from gsmerge.runtime.record import stage
from gsmerge.stages.assign import assign
from gsmerge.stages.decode import DecodeOptions, decode
from gsmerge.stages.encode import encode
from gsmerge.stages.fit import Fitted
from gsmerge.stages.prepare import Prepared
from gsmerge.types import Gaussians, Groups, Scene

Need = Literal["photos", "pixels", "node"]
Run = Callable[[Prepared, Plan, int], Gaussians]

COUNTS = ("budget", "superpixels", "k")  # settings that decide how many


@dataclass(frozen=True)
class Baseline:
    """One other method."""

    name: str  # as on the command line
    # prepared scene, plan, number of Gaussians -> canonical Gaussians, at most that many unless the method keeps the
    # input's. It times itself, by stages of the record.
    run: Run
    # ``"photos"``; ``"pixels"``: one Gaussian per pixel; ``"node"``: a program that runs in Node.js
    needs: tuple[Need, ...] = ()
    uses: tuple[str, ...] = COUNTS  # settings that it uses, by flat name, besides those that all methods use

    def build(self, prepared: Prepared, plan: Plan, count: int | None) -> Fitted:
        """Build ``count`` canonical Gaussians; None: as many as ``superpixels`` and K give."""
        gaussians = self.run(prepared, plan, plan.limits.default if count is None else count)
        return Fitted(gaussians, prepared.scene.cameras, None)


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
