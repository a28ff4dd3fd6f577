"""Estimate how much new views gain, by a trial on small photos that a short fit did not see.

Scores on photos that a fit has seen only say how well it remembers them. So the trial leaves out some views with their
rows, and compacts the other views at a small size. The rows of the other views and the result are both scored on the
photos that were left out, over the pixels that the rows cover.
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

SIDE = 120  # the longer side of the small pictures is at least so many pixels long
# Most steps of the fit. Fewer than 150 steps fit few views differently (gsmerge.fit.schedule.MANY_STEPS), and say less
STEPS = 200
# Small pictures have more detail in each pixel, so fewer Gaussians cost them more. The trial's share of Gaussians,
# relative to the usual share, is that of the result to the power of LESS. On five captures at 1 % this lowers the error
# of the estimated gain from 2.3 to 1.0 dB
USUAL, LESS = parse_share(SHARE), 0.3
# OWN is the weight of the gain of own photos, where depth is confirmed; the rest is the weight of the trial's gain. It
# was chosen on ten captures. On these and five others 80 % of the results lie within SPREAD dB of the estimate
# (docs/internals/notebook.md). Nothing is known about more than MOST_SHARE Gaussians for each pixel
OWN, SPREAD, MOST_SHARE = 0.2, 1.25, 0.1


@dataclass(frozen=True)
class NewViews(ExpectedScores):
    """PSNR (dB) that new views of a scene are expected to have, estimated on so many ``views``."""

    views: int

    @property
    def gain(self) -> float:
        """PSNR that a new view gains, dB."""
        return self.after - self.before

    def to_dict(self) -> dict[str, float]:
        """Return the numbers for a report."""
        return {name: round(value, 4) for name, value in asdict(self).items()}


@dataclass(frozen=True)
class Trial:
    """PSNR (dB) of small photos that short fits have not seen."""

    own_before: float  # Rendered from all rows of the input
    before: float  # Rendered from the rows of other views
    after: float  # Rendered from the compact result of these rows
    views: int  # Number of left-out photos that count

    def predict(self, own_before: float, own_after: float, confirmed: float) -> NewViews:
        """Predict the PSNR of new views of a result.

        ``own_before`` and ``own_after`` are the PSNR (dB) of its own photos, from the input and from the result;
        ``confirmed`` is the share of confirmed depth. New views gain at most this share of the gain of own photos. The
        input shows new views as much worse than own photos as in the trial.
        """
        most = confirmed * max(0.0, own_after - own_before)
        gain = OWN * most + (1 - OWN) * min(self.after - self.before, most)
        before = own_before + self.before - self.own_before
        before, after, low, high = (round(psnr, 2) for psnr in (before, before + gain, gain - SPREAD, gain + SPREAD))
        return NewViews(before, after, low, high, self.views)  # rounded as in files


def trial_part(prepared: Prepared, plan: Plan) -> Part | None:
    """Return the cost of the trial on views that are left out; None if there is no trial."""
    if not _has_trial(prepared, plan):
        return None
    scene, num_rounds = prepared.scene, len(choose_views(prepared.reference.score_views))
    pixels = scene.pixels_per_view / _reduction(scene) ** 2
    fits = fit_cost(min(STEPS, plan.fit.steps), pixels, USUAL * pixels * len(scene))
    before, after = (num_rounds * each * pixels * len(scene) for each in (BEFORE, AFTER))
    return Part(before, num_rounds * fits, after, num_rounds)


def _has_trial(prepared: Prepared, plan: Plan) -> bool:
    return plan.new_views and prepared.agreement is not None and can_leave_out(prepared)


def _reduction(scene: PicturedScene) -> int:
    """Return by which factor the sides of the trial's pictures are shorter."""
    return max(1, max(scene.cameras.width, scene.cameras.height) // SIDE)


def try_new_views(prepared: Prepared, plan: Plan, build: Build, count: int) -> Trial | None:
    """Measure in a trial what views gain that a fit of ``count`` Gaussians leaves out.

    None with too few views or photos, or too many Gaussians. None also if views have no Gaussians of their own: then
    the Gaussians still hold what the left-out photos showed, which makes the error 2 dB instead of 1.2, and the trial
    takes a quarter of a run's time.
    """
    scene = prepared.scene
    pixels = scene.pixels_per_view * len(scene)
    if not _has_trial(prepared, plan) or count > MOST_SHARE * pixels:
        return None
    begin_part()
    with record_part(silent=True) as record:
        small = shrink_scene(scene, _reduction(scene))
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
    """Compact the rest with a short fit, and score it on the photos that are left out.

    Returns ``[4,v]``: for each photo the share that the rest sees, and the PSNR (dB) of renders from all rows, from the
    rows of the rest, and from the result.
    """
    superpixels = max(1, round(share * small.pixels_per_view))
    short = left_out.plan(plan, superpixels=superpixels, k=1, fit_steps=min(STEPS, plan.fit.steps))
    # views from outside the photos' region are of no use here: no photo shows what they see
    inside = replace(short.fit, tuning=replace(short.fit.tuning, outside_from=1.0))
    compacted = build(left_out.rest, replace(short, fit=inside), None).gaussians
    drawn = small.file_gaussians, left_out.rows, compacted
    return np.stack([left_out.shares, *(left_out.score(gaussians) for gaussians in drawn)])


def shrink_scene(scene: PicturedScene, step: int) -> PicturedScene:
    """Shrink the pictures by a factor ``step`` per side, and keep the front Gaussian of each remaining pixel."""
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
