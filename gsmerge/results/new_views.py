"""Estimate how much new views gain, by a trial on small photos that a short fit has not seen.

Scores on photos that a fit has seen only say how well the fit remembers these photos. The trial therefore leaves out
some views with their Gaussians, and compacts the other views at a small size. The photos that were left out then score
the Gaussians of the other views before and after compaction, over the pixels that the other views see.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter

import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.geometry.transforms import camera_distances
from gsmerge.method.geometry.views import subset
from gsmerge.method.kernels.elementary import power
from gsmerge.method.pipelines.build import build
from gsmerge.method.pipelines.plan import Plan
from gsmerge.method.raster.photos import shrink_pictures
from gsmerge.results.left_out import LEAST_SEEN, choose_left_out, leave_out, mean_seen
from gsmerge.results.report import CompactReport, NewViews, compared_psnr
from gsmerge.runtime.record import begin_part, record_part
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.budget import parse_share
from gsmerge.settings.stages import SHARE
from gsmerge.types import PicturedScene, Pixels

TRIAL_PIXELS = 120  # the longer side of the small pictures has at least this many pixels
# Most steps of the fit. With fewer than 150 steps, fits of few views have other settings than longer fits
# (gsmerge.method.fit.schedule.MANY_STEPS), and predict less; on fifteen captures, 200 steps predict no better
TRIAL_STEPS = 150
# Most views of a round: those nearest to the left-out views. Farther views show little of what the left-out views show.
# With more than TRIAL_VIEWS views, a fit of TRIAL_STEPS steps would also draw each view too seldom to predict a longer
# fit
TRIAL_VIEWS = 64
# Small pictures have more detail in each pixel, so they lose more with few Gaussians. The trial therefore has more
# Gaussians per pixel than the result. If the result has x times the usual number of Gaussians per pixel, the trial has
# x to the power of SHARE_POWER times the usual number. On five captures, for results with 1 % of the Gaussians, this
# lowers the error of the estimated gain from 2.3 to 1.0 dB
USUAL_DENSITY = parse_share(SHARE)
SHARE_POWER = 0.3
# The expected gain of new views is a weighted mean of two gains: the gain of the result's own photos, as far as depth
# is confirmed, with the weight OWN_WEIGHT, and the gain of left-out photos in the trial. On ten captures and on five
# others, the true gain of at least 80 % of the results lies between these two gains, or at most SPREAD dB outside of
# them (docs/internals/decisions.md#new-views). Nothing is known about results with more than MOST_SHARE Gaussians for
# each pixel
OWN_WEIGHT = 0.2
SPREAD = 1.25
MOST_SHARE = 0.1


@dataclass(frozen=True)
class Trial:
    """What a trial measured: the PSNR (dB) of renders of three sets of Gaussians, against small left-out photos."""

    own_before: float  # All Gaussians of the input, including those of the left-out views
    before: float  # The Gaussians of the other views
    after: float  # The result that the trial made of the other views
    views: int  # Number of left-out photos that count

    def predict(self, own_before: float, own_after: float, confirmed: float) -> NewViews:
        """Predict the PSNR of new views of a result.

        ``own_before`` and ``own_after`` are the PSNR (dB) of the result's own photos, rendered from the input and from
        the result. ``confirmed`` is the share of the pixels whose depth other views confirm. New views gain at most
        this share of the gain of the result's own photos. The input is assumed to show new views worse than its own
        views, by the same difference as in the trial.
        """
        most_gain = confirmed * max(0.0, own_after - own_before)
        least_gain = min(self.after - self.before, most_gain)
        before = own_before + self.before - self.own_before
        after = before + OWN_WEIGHT * most_gain + (1 - OWN_WEIGHT) * least_gain
        # files have two digits
        low = round(least_gain - SPREAD, 2)
        high = round(most_gain + SPREAD, 2)
        return NewViews(round(before, 2), round(after, 2), low, high, self.views)


def expect_new_views(report: CompactReport, prepared: Prepared, plan: Plan) -> CompactReport:
    """Return the report with the PSNR of new views that a trial predicts.

    The report is returned without a prediction if the result has too many Gaussians for a trial, or no scores. It gets
    a doubt if new views of the result are expected to be worse than those of the input, unless it says already that the
    result is worse.
    """
    start = perf_counter()
    trial = try_new_views(prepared, plan, report.num_output)
    report = replace(report, seconds=report.seconds | {"new views": perf_counter() - start})
    before, after = compared_psnr(report.covered, report.psnr_before, report.psnr_after)
    if trial is None or prepared.agreement is None or before is None or after is None:
        return report
    expected = trial.predict(before, after, prepared.agreement.confirmed)
    report = replace(report, new_views=expected)
    # a trial on very small pictures says too little for a warning
    is_large = max(prepared.scene.cameras.width, prepared.scene.cameras.height) >= TRIAL_PIXELS
    if not is_large or report.worse is not None or expected.gain >= -SPREAD:
        return report
    return report.with_worse(
        f"new views of the result are expected to be {-expected.gain:.1f} dB worse than those of the input"
    )


def try_new_views(prepared: Prepared, plan: Plan, count: int) -> Trial | None:
    """Run the trial for a result of ``count`` Gaussians, in two rounds at once, and return what it measured.

    Steps on small pictures spend most of their time in Python, on one processor, so each round has a thread.
    None if a trial could not predict a result of so many Gaussians, or if no view sees what left-out photos show.
    """
    pixels = prepared.scene.pixels_per_view * len(prepared.scene)
    if count > MOST_SHARE * pixels:
        return None
    share = min(1.0, USUAL_DENSITY * float(power(count / (USUAL_DENSITY * pixels), SHARE_POWER)))
    views_of_rounds = choose_left_out(prepared.reference.score_views)
    begin_part("trial")
    rounds = parallel_map(lambda views: _score_round(prepared, views, plan, share), views_of_rounds)
    scores = [round_scores for round_scores in rounds if round_scores is not None]
    if not scores:
        return None
    shares, *psnrs = np.concatenate(scores, 1)
    own, before, after = (mean_seen(photo_psnrs, shares) for photo_psnrs in psnrs)
    return Trial(own, before, after, int((shares > LEAST_SEEN).sum()))


@record_part(silent=True)
def _score_round(prepared: Prepared, views: Sequence[int], plan: Plan, share: float) -> np.ndarray | None:
    """Leave out ``views``, compact other views near them at a small size, and score the result on the left-out photos.

    ``share`` is the number of Gaussians per pixel. Returns an array ``[4,v]``, whose rows are the share of each photo
    that the other views see, and the PSNR (dB) of renders from all Gaussians, from the Gaussians of the other views,
    and from the result. Returns None if no other view sees what the left-out photos show.
    """
    distances = camera_distances(prepared.scene.cameras)[list(views)].min(0)
    distances[list(views)] = -1.0  # the left-out views come first, then the nearest others
    used_views = sorted(np.argsort(distances, kind="stable")[:TRIAL_VIEWS].tolist())
    scene = prepared.scene if len(used_views) == len(prepared.scene) else subset(prepared.scene, used_views)
    small = shrink_scene(scene, max(1, max(scene.cameras.width, scene.cameras.height) // TRIAL_PIXELS))
    left_out = leave_out(small, [used_views.index(view) for view in views], prepared)
    if left_out is None:
        return None
    superpixels = max(1, round(share * small.pixels_per_view))
    trial_plan = left_out.plan(plan, superpixels=superpixels, k=1, fit_steps=min(TRIAL_STEPS, plan.fit.steps))
    # The fit draws no views from outside, and nothing is pruned. Views from outside and pruning hardly change the score
    # (docs/internals/decisions.md#new-views)
    fit = replace(trial_plan.fit, tuning=replace(trial_plan.fit.tuning, outside_from=1.0))
    compacted = build(left_out.rest, replace(trial_plan, fit=fit, is_trial=True), None).gaussians
    scored = small.file_gaussians, left_out.rows, compacted
    return np.stack([left_out.shares, *(left_out.score(gaussians) for gaussians in scored)])


def shrink_scene(scene: PicturedScene, step: int) -> PicturedScene:
    """Shrink the pictures by a factor ``step`` per side.

    A new pixel gets the front Gaussian of the old pixel in its middle. The scales of this Gaussian become ``step``
    times as large.
    """
    cameras = scene.cameras
    shape = scene.images.shape[1:3]
    height, width = (max(1, side // step) for side in shape)
    Ks = cameras.Ks / np.array([[step], [step], [1]], cameras.Ks.dtype)
    cut = slice(None), slice(0, height * step), slice(0, width * step)
    images = shrink_pictures(scene.images[cut], width, height)
    middle = slice(None), slice(step // 2, height * step, step), slice(step // 2, width * step, step)
    masks, empty, importance = (
        None if values is None else values[middle] for values in (scene.masks, scene.empty, scene.importance)
    )
    fronts = scene.get_pixels().fronts[middle]
    rows = fronts[fronts >= 0]
    gaussians = scene.gaussians[rows]
    return replace(
        scene, cameras=replace(cameras, Ks=Ks, width=width, height=height), images=images, masks=masks,
        empty=empty, importance=importance, large_photos=None,
        gaussians=replace(gaussians, scales=gaussians.scales * np.float32(step)), pixels=Pixels.of_grid(fronts >= 0),
        filled=None if scene.filled is None else scene.filled[rows],
    )  # fmt: skip
