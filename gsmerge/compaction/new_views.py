"""What a new viewpoint gains: photos that a short fit of small pictures did not see, before and after.

Scores of the photos that a fit has seen say how well it remembers them. So some views are left out with their rows, the
rest is compacted at a quarter of the size, and its rows and its result are compared with the photos that were left out,
where the rows cover them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

from gsmerge.compaction.forecast import AFTER, BEFORE, fit_cost
from gsmerge.compaction.left_out import LEAST_SEEN, LeftOut, can_leave_out, choose_views, leave_out, mean_seen
from gsmerge.facts.prepare import Prepared
from gsmerge.io.formats.arrays import ExpectedScores
from gsmerge.kernels.elementary import power
from gsmerge.pipeline import Build
from gsmerge.plan import Plan
from gsmerge.raster.photos import shrink_pictures
from gsmerge.runtime.record import add_seconds, begin_part, record_part
from gsmerge.runtime.time_left import Part
from gsmerge.settings.budget import parse_share
from gsmerge.settings.stages import SHARE
from gsmerge.types import PicturedScene, Pixels

SIDE = 120  # pixels of the longer side, at least
# Of the fit, at most: fewer than 150 fit few views in another way (gsmerge.fit.schedule.MANY_STEPS), and say less
STEPS = 200
# Small pictures have more detail to a pixel, so that fewer Gaussians cost them more: theirs are as many times the usual
# share as the result's times, to this power. Gains at 1 % of five captures: 1.0 dB off for 2.3.
USUAL, LESS = parse_share(SHARE), 0.3
# A fifth of what new views gain is that of own photos where depth is confirmed, the rest that of the trial: chosen on
# ten captures, of which, and of five others, 80 % of the results lie within SPREAD dB of it
# (docs/internals/notebook.md). Beyond MOST_SHARE Gaussians for a pixel nothing is known
OWN, SPREAD, MOST_SHARE = 0.2, 1.25, 0.1


@dataclass(frozen=True)
class NewViews(ExpectedScores):
    """PSNR (dB) that new views of a scene are expected to have, and of how many ``views`` that was estimated."""

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

    def predict(self, own_before: float, own_after: float, confirmed: float) -> NewViews:
        """Predict new views of a result from the PSNR (dB) of its own photos, and the share of confirmed depth.

        New views gain no more than own photos do where depth is confirmed. The input shows them as much worse than own
        photos as it does small ones.
        """
        most = confirmed * max(0.0, own_after - own_before)
        gain = OWN * most + (1 - OWN) * min(self.after - self.before, most)
        before = own_before + self.before - self.own_before
        before, after, low, high = (round(psnr, 2) for psnr in (before, before + gain, gain - SPREAD, gain + SPREAD))
        return NewViews(before, after, low, high, self.views)  # as files say it


def trial_part(prepared: Prepared, plan: Plan) -> Part | None:
    """Return the cost of the trial on views that are left out; None where there is none."""
    if not _has_trial(prepared, plan):
        return None
    scene, num_rounds = prepared.scene, len(choose_views(prepared.reference.score_views))
    pixels = scene.pixels_per_view / _shrinking(scene) ** 2
    fits = fit_cost(min(STEPS, plan.fit.steps), pixels, USUAL * pixels * len(scene))
    before, after = (num_rounds * each * pixels * len(scene) for each in (BEFORE, AFTER))
    return Part(before, num_rounds * fits, after, num_rounds)


def _has_trial(prepared: Prepared, plan: Plan) -> bool:
    return plan.new_views and prepared.agreement is not None and can_leave_out(prepared)


def _shrinking(scene: PicturedScene) -> int:
    """Return how many times smaller the pictures of the trial are."""
    return max(1, max(scene.cameras.width, scene.cameras.height) // SIDE)


def try_new_views(prepared: Prepared, plan: Plan, build: Build, count: int) -> Trial | None:
    """Try what views gain that a fit of ``count`` Gaussians leaves out.

    None where views or photos are too few, or Gaussians too many; and where views have no Gaussians of their own, since
    those hold what photos showed that are left out: errors of 2 dB for 1.2, for a quarter of a run's time.
    """
    scene = prepared.scene
    pixels = scene.pixels_per_view * len(scene)
    if not _has_trial(prepared, plan) or count > MOST_SHARE * pixels:
        return None
    begin_part()
    with record_part(silent=True) as record:
        small = shrink_scene(scene, _shrinking(scene))
        share = min(1.0, USUAL * float(power(count / (USUAL * pixels), LESS)))
        rounds = [leave_out(small, views, prepared) for views in choose_views(prepared.reference.score_views)]
        scores = [_score_round(left_out, small, plan, build, share) for left_out in rounds if left_out is not None]
    add_seconds({"new views": sum(record.seconds.values())})
    if not scores:
        return None
    shares, *each = np.concatenate(scores, 1)
    own, before, after = (mean_seen(psnr, shares) for psnr in each)
    return Trial(own, before, after, int((shares > LEAST_SEEN).sum()))


def _score_round(left_out: LeftOut, small: PicturedScene, plan: Plan, build: Build, share: float) -> np.ndarray:
    """Compact the rest with a short fit.

    Returns ``[4,v]``: of each photo that is left out the share that the rest sees, and its PSNR rendered from all rows,
    from those of the rest, and from the result.
    """
    superpixels = max(1, round(share * small.pixels_per_view))
    short = left_out.plan(plan, superpixels=superpixels, k=1, fit_steps=min(STEPS, plan.fit.steps))
    inside = replace(short.fit, tuning=replace(short.fit.tuning, outside_from=1.0))  # no photo shows what is outside
    compacted = build(left_out.rest, replace(short, fit=inside), None).gaussians
    drawn = small.file_gaussians, left_out.rows, compacted
    return np.stack([left_out.shares, *(left_out.score(gaussians) for gaussians in drawn)])


def shrink_scene(scene: PicturedScene, step: int) -> PicturedScene:
    """Keep every so many rows and columns of pixels, and the Gaussians in front of them."""
    cameras, shape = scene.cameras, scene.images.shape[1:3]
    height, width = (max(1, side // step) for side in shape)
    Ks = cameras.Ks / np.array([[step], [step], [1]], cameras.Ks.dtype)
    cut = slice(None), slice(0, height * step), slice(0, width * step)
    images = shrink_pictures(scene.images[cut], width, height)
    middle = slice(None), slice(step // 2, height * step, step), slice(step // 2, width * step, step)
    masks, empty, importance = (
        None if values is None else values[middle] for values in (scene.masks, scene.empty, scene.importance)
    )
    fronts = scene.get_pixels().fronts[middle]
    rows, chosen = fronts[fronts >= 0], scene.gaussians[fronts[fronts >= 0]]
    return replace(
        scene, cameras=replace(cameras, Ks=Ks, width=width, height=height), images=images, masks=masks,
        empty=empty, importance=importance, large_photos=None,
        gaussians=replace(chosen, scales=chosen.scales * np.float32(step)), pixels=Pixels.of_grid(fronts >= 0),
        filled=None if scene.filled is None else scene.filled[rows],
    )  # fmt: skip
