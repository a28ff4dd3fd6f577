"""Leave views out of a scene, so that results can be scored on photos that their fit has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.method.facts.pictures import PHOTOS
from gsmerge.method.facts.prepared import Prepared, Reference
from gsmerge.method.geometry.views import pick_views, subset
from gsmerge.method.pipelines.plan import Plan
from gsmerge.method.raster.photos import NEAR_PLANE, Photos, scene_photos, score_photos
from gsmerge.plan.make_plan import make_plan
from gsmerge.scoring.visibility import context_points, visible_pixels
from gsmerge.settings.compact import OURS, TRIAL, CompactOptions
from gsmerge.types import Gaussians, PicturedScene

# One of every LEFT_OUT_PART views is left out at a time, but at most MOST_LEFT_OUT views
LEFT_OUT_PART = 6
MOST_LEFT_OUT = 3
LEAST_SEEN = 0.02  # a left-out photo counts if the other views see more than this share of it


@dataclass(frozen=True, eq=False)
class LeftOut:
    """A scene without some of its views, and the photos of the views that are left out."""

    rest: Prepared  # The scene of the other views
    photos: Photos  # Photos of the v views that are left out
    seen: np.ndarray  # [v,h,w] bool, pixels of these photos that show what the other views see

    @property
    def shares(self) -> np.ndarray:
        """Share ``[v]`` of each photo that the other views see."""
        return self.seen.mean((1, 2))

    @property
    def rows(self) -> Gaussians:
        """Gaussians of the input that come from the other views."""
        return self.rest.scene.file_gaussians

    def score(self, gaussians: Gaussians) -> np.ndarray:
        """Return the PSNR (dB) ``[v]`` of canonical Gaussians on each photo, over the pixels that other views see."""
        views = enumerate(self.seen)
        return np.array([score_photos(gaussians, self.photos, [i], covered=[mask]).covered_psnr for i, mask in views])

    def reduce(self, count: int) -> int:
        """Return the number of Gaussians for the other views, if the whole scene has ``count`` Gaussians."""
        views = len(self.rest.scene)
        return max(1, round(count * views / (views + len(self.photos))))

    def plan(self, plan: Plan, **settings: Any) -> Plan:
        """Plan a run on the remaining views, with the settings of ``plan``, except that ``settings`` replace some.

        Settings that depend on the whole scene, such as a crop, are replaced by those of ``TRIAL``.
        """
        settings = plan.settings | TRIAL | settings
        # without networks in the plan, the settings must not ask for any
        settings |= {"method": OURS, "checkpoint": "none"} if plan.merge.checkpoint is None else {}
        return make_plan(self.rest, CompactOptions().with_settings(settings), plan.merge.checkpoint, plan.pipeline)


def leave_out(scene: PicturedScene, views: Sequence[int], prepared: Prepared) -> LeftOut | None:
    """Leave ``views`` out of a canonical scene with photos; None if no other view sees what these views show."""
    rest = subset(scene, [view for view in range(len(scene)) if view not in views])
    if not views or len(rest.file_gaussians) == 0:
        return None
    rest_ids = tuple(range(len(rest)))
    prepared_rest = replace(
        prepared, input_scene=rest, scene=rest, reference=Reference(PHOTOS, rest_ids), repeated=rest_ids, moved=False,
        agreement=None,
    )  # fmt: skip
    left_out_views = subset(scene, views)
    left_out = LeftOut(prepared_rest, scene_photos(left_out_views), mark_seen(rest, left_out_views))
    return left_out if (left_out.shares > LEAST_SEEN).any() else None


def mean_seen(scores: np.ndarray, shares: np.ndarray) -> float:
    """Average the scores ``[v]`` of left-out photos, weighted by the ``shares [v]`` of each that other views see.

    A photo does not count if other views see almost nothing of it.
    """
    counts = shares > LEAST_SEEN
    return float(np.average(scores[counts], weights=shares[counts]))


def choose_left_out(views: Sequence[int]) -> tuple[list[int], list[int]]:
    """For each of two rounds, choose views to leave out, evenly spread among ``views``.

    The chosen views belong to the first and the second round in turn, so no round leaves out two neighbours.
    """
    count = min(MOST_LEFT_OUT, max(1, len(views) // LEFT_OUT_PART))
    spread = [views[i] for i in pick_views(len(views), 2 * count)]
    return spread[::2], spread[1::2]


def mark_seen(rest: PicturedScene, views: PicturedScene) -> np.ndarray:
    """Return a mask ``[v,h,w]`` of the pixels of ``views`` whose surfaces are also visible in views of the ``rest``."""
    return visible_pixels(context_points(rest, NEAR_PLANE), views.cameras, NEAR_PLANE, rest.cameras)
