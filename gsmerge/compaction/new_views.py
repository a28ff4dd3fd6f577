"""What a new viewpoint gains: photos that a short fit of small pictures did not see, before and after.

Scores of the photos that a fit has seen say how well it remembers them. So some views, those that the others see most
of, are left out with their rows, the rest is compacted at a quarter of the size, and its rows and its result are
compared with the photos that were left out, where the rows cover them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from gsmerge.facts.confirm_depths import Agreement
from gsmerge.facts.prepare import Prepared, Reference
from gsmerge.facts.row_colors import PHOTOS
from gsmerge.facts.views import pick_views, subset
from gsmerge.geometry import nearest_views
from gsmerge.kernels.elementary import power
from gsmerge.measure.visibility import context_points, visible_pixels
from gsmerge.pipeline import Build
from gsmerge.plan import Plan, make_plan
from gsmerge.raster.photos import NEAR, scene_photos, score_photos, shrink_pictures
from gsmerge.runtime.record import add_seconds, record_part
from gsmerge.settings.budget import parse_share
from gsmerge.settings.compact import OURS, CompactOptions
from gsmerge.settings.stages import SHARE
from gsmerge.types import Gaussians, PicturedScene, grid_ids

LEAST_VIEWS = 4  # with photos: fewer are alone when one is left out
SIDE = 120  # pixels of the longer side, at least
STEPS = 120  # of the fit, at most
PART, MOST = 6, 3  # one of so many views is left out in each of two rounds, at most so many
CANDIDATES = 24  # views among which they are chosen
COARSE = 4  # times a small pixel: what others see is measured by
LEAST_SEEN = 0.02  # share of a left-out photo that the others must cover
# Share of what the result's own photos gain that new views gain at most, where depth is not known to be confirmed. On
# ten training captures it is .1 to .95, at most .07 above the share of confirmed depth; small pictures alone say more
# where detail is finer than they show.
MOST_KEPT = 0.85
# Small pictures have more detail to a pixel, so that fewer Gaussians cost them more: theirs are as many times the usual
# share as the result's times, to this power. Gains at 1 % of five captures: 1.0 dB off for 2.3.
USUAL, LESS = parse_share(SHARE), 0.3
# What a run of these settings decides by work on the whole scene, or leaves out of the result
LEFT_TO_RUN: dict[str, Any] = {
    "budget": None, "quality": None, "levels": 1, "crop": None, "drop": None, "time_budget": None, "photo_scale": 1.0,
    "poses": "fixed", "exposure": "fixed", "blocks": "none", "recipe": None, "new_views": False,
}  # fmt: skip


@dataclass(frozen=True)
class NewViews:
    """PSNR (dB) that new views of a scene are expected to have.

    Args:
        before: Rendered from the input.
        after: From the result.
        views: Number of the photos that this was estimated on.
    """

    before: float
    after: float
    views: int

    @property
    def gain(self) -> float:
        """How much nearer a new view comes, dB."""
        return self.after - self.before

    def to_dict(self) -> dict[str, float]:
        """Return the numbers for a report."""
        return {name: round(value, 4) for name, value in asdict(self).items()}


@dataclass(frozen=True)
class Trial:
    """PSNR (dB) of small photos that short fits have not seen."""

    own_before: float  # Rendered from all rows of the input
    before: float  # From those of other views
    after: float  # From what these were compacted to
    views: int

    def predict(self, own_before: float, own_after: float, agreement: Agreement | None) -> NewViews:
        """Predict new views of a result from the PSNR (dB) of its own photos.

        Small rows hide gaps between those of the file, by so much as they show own photos better. New views gain no
        more than the share of what own photos gain that is confirmed depth.
        """
        most = MOST_KEPT if agreement is None else agreement.confirmed
        before = self.before + min(0.0, own_before - self.own_before)
        gain = min(self.after - before, most * max(0.0, own_after - own_before))
        return NewViews(round(before, 2), round(before + gain, 2), self.views)  # as files say it


def try_new_views(prepared: Prepared, plan: Plan, build: Build, count: int) -> Trial | None:
    """Try what views gain that a fit of ``count`` Gaussians leaves out; None where views or photos are too few."""
    scene, views = prepared.scene, prepared.reference.score_views
    if not plan.new_views or prepared.reference.name != PHOTOS or len(views) < LEAST_VIEWS:
        return None
    with record_part(silent=True) as record:
        small = shrink_scene(scene, max(1, max(scene.cameras.width, scene.cameras.height) // SIDE))
        times = count / (USUAL * scene.pixels_per_view * len(scene))
        share = min(1.0, USUAL * float(power(times, LESS)))
        rounds = [_leave_out(small, part, prepared, plan, build, share) for part in choose_views(small, views)]
    add_seconds({"new views": sum(record.seconds.values())})
    shares, *scores = np.concatenate(rounds, 1)
    seen = shares > LEAST_SEEN
    if not seen.any():
        return None
    own, before, after = (float(np.average(score[seen], weights=shares[seen])) for score in scores)
    return Trial(own, before, after, int(seen.sum()))


def _leave_out(
    small: PicturedScene, views: Sequence[int], prepared: Prepared, plan: Plan, build: Build, share: float
) -> np.ndarray:
    """Leave out views and compact the others: share covered, and PSNR from all rows, before and after, ``[4,n]``."""
    rest = subset(small, [view for view in range(len(small)) if view not in views])
    if len(_file_rows(rest)) == 0 or not views:
        return np.zeros((4, len(views)))
    left_out, compacted = subset(small, views), _compact_rest(rest, prepared, plan, build, share)
    photos, covered = scene_photos(left_out), _covered(rest, left_out)
    scores = [
        [score_photos(drawn, photos, [i], covered=[mask]).covered_psnr for i, mask in enumerate(covered)]
        for drawn in (_file_rows(small), _file_rows(rest), compacted)
    ]
    return np.array([covered.mean((1, 2)), *scores])


def shrink_scene(scene: PicturedScene, step: int) -> PicturedScene:
    """Keep every so many rows and columns of pixels; Gaussians without pixels all stay."""
    cameras, shape = scene.cameras, scene.images.shape[1:3]
    height, width = (max(1, side // step) for side in shape)
    Ks = cameras.Ks / np.array([[step], [step], [1]], cameras.Ks.dtype)
    cut = slice(None), slice(0, height * step), slice(0, width * step)
    images = shrink_pictures(scene.images[cut], width, height)
    middle = slice(None), slice(step // 2, height * step, step), slice(step // 2, width * step, step)
    masks, missing, empty = (
        None if mask is None else mask[middle] for mask in (scene.masks, scene.missing, scene.empty)
    )
    small = replace(
        scene, cameras=replace(cameras, Ks=Ks, width=width, height=height), images=images, masks=masks,
        empty=empty, gaussians=scene.gaussians[:0], pixel_ids=None, missing=None, large_photos=None,
    )  # fmt: skip
    if not scene.aligned:
        return replace(small, gaussians=scene.gaussians)
    rows = np.arange(len(scene.gaussians)).reshape(scene.valid.shape)[middle].reshape(-1)
    gaussians = scene.gaussians[rows]
    gaussians = replace(gaussians, scales=gaussians.scales * np.float32(step))
    return replace(small, gaussians=gaussians, pixel_ids=grid_ids(scene.valid[middle]), missing=missing)


def choose_views(scene: PicturedScene, views: Sequence[int]) -> list[list[int]]:
    """Choose views to leave out in each of two rounds: those that the others see most of, no neighbours together."""
    count = min(MOST, max(1, len(views) // PART))
    candidates = [views[place] for place in pick_views(len(views), CANDIDATES)]
    if scene.aligned:
        coarse = shrink_scene(scene, COARSE)
        candidates.sort(key=lambda view: -_seen(coarse, view))
    rounds: list[list[int]] = [[], []]
    near = {view: set(nearest_views(scene.cameras.centres, view)[:2].tolist()) for view in candidates}
    for view in candidates:
        for chosen in sorted(rounds, key=len):
            if len(chosen) < count and not any(view in near[other] for other in chosen):
                chosen.append(view)
                break
    return rounds


def _seen(scene: PicturedScene, view: int) -> float:
    """Return the share of a view's pixels on which Gaussians of other views fall."""
    others = subset(scene, [other for other in range(len(scene)) if other != view])
    return float(_covered(others, subset(scene, [view])).mean())


def _file_rows(scene: PicturedScene) -> Gaussians:
    """Return the Gaussians that the file has, without those that fill holes."""
    return scene.gaussians[scene.stored_rows]


def _covered(rest: PicturedScene, views: PicturedScene) -> np.ndarray:
    """Mark the pixels ``[v,h,w]`` of views that surfaces which views of the ``rest`` see cover."""
    points = _file_rows(rest).means.astype(np.float64) if rest.aligned else context_points(rest, NEAR)
    return visible_pixels(points, views.cameras, NEAR, rest.cameras)


def _compact_rest(rest: PicturedScene, prepared: Prepared, plan: Plan, build: Build, share: float) -> Gaussians:
    """Compact small views as a run does, with a short fit."""
    every = tuple(range(len(rest)))
    part = replace(
        prepared, input_scene=rest, scene=rest, reference=Reference(PHOTOS, every, every), repeated=every, moved=False,
        unseen=rest.gaussians[:0], agreement=None,
    )  # fmt: skip
    steps = min(STEPS, plan.fit.steps)
    settings = (
        plan.settings
        | LEFT_TO_RUN
        | {"superpixels": max(1, round(share * rest.pixels_per_view)), "k": 1, "fit_steps": steps}
    )
    settings |= {"method": OURS, "checkpoint": "none"} if plan.checkpoint is None else {}
    return build(part, make_plan(part, CompactOptions().with_settings(settings), plan.checkpoint), None).gaussians
