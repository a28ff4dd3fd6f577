"""Estimate how much new views gain, by a trial on small photos that a short fit has not seen.

Scores on photos that a fit has seen only say how well it remembers them. So the trial leaves some views out with their
Gaussians, and compacts the other views at a small size. Then both the other views' Gaussians and the result are scored
on the photos that were left out, over the pixels that these Gaussians cover.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from gsmerge.compaction.left_out import LEAST_SEEN, can_leave_out, choose_left_out, leave_out, mean_seen
from gsmerge.facts.prepare import Prepared
from gsmerge.geometry.transforms import camera_distances
from gsmerge.io.formats.arrays import ExpectedScores
from gsmerge.kernels.elementary import power
from gsmerge.photos.views import subset
from gsmerge.pipeline import Build
from gsmerge.plan import Plan
from gsmerge.raster.photos import shrink_pictures
from gsmerge.runtime.record import add_seconds, begin_part, record_part
from gsmerge.settings.budget import parse_share
from gsmerge.settings.stages import SHARE
from gsmerge.types import Cameras, PicturedScene, Pixels

TRIAL_PIXELS = 120  # the longer side of the small pictures has at least this many pixels
# Most steps of the fit. Below 150 steps, fits of few views are of another kind (gsmerge.fit.schedule.MANY_STEPS), and
# predict less
TRIAL_STEPS = 200
# Most views of a round, the nearest to those that are left out. With more views, TRIAL_STEPS would draw each too seldom
# to tell how a run with more steps ends. Besides, farther views show little of what the left-out views show
TRIAL_VIEWS = 64
# Small pictures have more detail in each pixel, so they lose more with few Gaussians. The trial therefore has a larger
# share of Gaussians per pixel. Relative to the usual share, it is that of the result to the power of LESS. On five
# captures at 1 % this lowers the error of the estimated gain from 2.3 to 1.0 dB
USUAL, LESS = parse_share(SHARE), 0.3
# The expected gain of new views is a mean of the gain of own photos, with the weight OWN and only where depth is
# confirmed, and of the gain in the trial. The true gain lies between the two, or at most SPREAD dB outside, for 80 % of
# the results or more, on ten captures as on five others (docs/internals/notebook.md). Nothing is known about more than
# MOST_SHARE Gaussians for each pixel
OWN, SPREAD, MOST_SHARE = 0.2, 1.25, 0.1


@dataclass(frozen=True)
class NewViews(ExpectedScores):
    """Expected PSNR (dB) of new views of a scene, as a trial predicts it."""

    views: int  # Number of left-out photos on which the trial measured

    @property
    def gain(self) -> float:
        """PSNR (dB) that a new view gains."""
        return self.after - self.before

    def to_dict(self) -> dict[str, float]:
        """Return the numbers for a report."""
        return {name: round(value, 4) for name, value in asdict(self).items()}


@dataclass(frozen=True)
class Trial:
    """What a trial measured: PSNR (dB) of small photos that its short fits have not seen."""

    own_before: float  # Rendered from all Gaussians of the input
    before: float  # Rendered from the Gaussians of the other views
    after: float  # Rendered from the result that the trial made of the other views
    views: int  # Number of left-out photos that count

    def predict(self, own_before: float, own_after: float, confirmed: float) -> NewViews:
        """Predict the PSNR of new views of a result.

        ``own_before`` and ``own_after`` are the PSNR (dB) of its own photos, rendered from the input and from the
        result. New views gain at most a part of what own photos gain: the share of ``confirmed`` depth. Renders of the
        input are assumed to be worse in new views than in its own views, by the same difference as in the trial.
        """
        most = confirmed * max(0.0, own_after - own_before)
        least = min(self.after - self.before, most)
        before = own_before + self.before - self.own_before
        after, low, high = before + OWN * most + (1 - OWN) * least, least - SPREAD, most + SPREAD
        return NewViews(round(before, 2), round(after, 2), round(low, 2), round(high, 2), self.views)  # as in files


def can_try(prepared: Prepared, count: int = 0) -> bool:
    """Return whether a trial is possible for a scene and says something about a result of ``count`` Gaussians."""
    pixels = prepared.scene.pixels_per_view * len(prepared.scene)
    return prepared.agreement is not None and can_leave_out(prepared) and count <= MOST_SHARE * pixels


def try_new_views(prepared: Prepared, plan: Plan, build: Build, count: int) -> Trial | None:
    """Run the trial for a result of ``count`` Gaussians, in two rounds, and return what it measured.

    None if the plan wants no trial, with too few views or photos, or with too many Gaussians. None also if views have
    no Gaussians of their own. The Gaussians would then still contain the left-out photos, so the error would be 2 dB
    instead of 1.2, and the trial would take a quarter of a run's time.
    """
    if not plan.new_views or not can_try(prepared, count):
        return None
    pixels = prepared.scene.pixels_per_view * len(prepared.scene)
    begin_part()
    with record_part(silent=True) as record:
        share = min(1.0, USUAL * float(power(count / (USUAL * pixels), LESS)))
        chosen = choose_left_out(prepared.reference.score_views)
        rounds = [_score_round(prepared, views, plan, build, share) for views in chosen]
        scores = [round_scores for round_scores in rounds if round_scores is not None]
    add_seconds({"new views": sum(record.seconds.values())})
    if not scores:
        return None
    shares, *psnrs = np.concatenate(scores, 1)
    own, before, after = (mean_seen(photo_psnrs, shares) for photo_psnrs in psnrs)
    return Trial(own, before, after, int((shares > LEAST_SEEN).sum()))


def _score_round(prepared: Prepared, views: Sequence[int], plan: Plan, build: Build, share: float) -> np.ndarray | None:
    """Compact the views around ``views`` without these, at a small size, and score the result on their photos.

    Returns an array ``[4,v]``. Its rows are the share of each photo that the remaining views see, and the PSNR (dB) of
    renders from all Gaussians, from those of the remaining views, and from the result. None if no remaining view sees
    what the photos show.
    """
    around = views_around(prepared.scene.cameras, views, TRIAL_VIEWS)
    scene = prepared.scene if len(around) == len(prepared.scene) else subset(prepared.scene, around)
    small = shrink_scene(scene, max(1, max(scene.cameras.width, scene.cameras.height) // TRIAL_PIXELS))
    left_out = leave_out(small, [around.index(view) for view in views], prepared)
    if left_out is None:
        return None
    superpixels = max(1, round(share * small.pixels_per_view))
    short = left_out.plan(plan, superpixels=superpixels, k=1, fit_steps=min(TRIAL_STEPS, plan.fit.steps))
    # Without views from outside and without pruning, which hardly change the score (docs/internals/notebook.md)
    inside = replace(short.fit, tuning=replace(short.fit.tuning, outside_from=1.0))
    compacted = build(left_out.rest, replace(short, fit=inside, is_trial=True), None).gaussians
    drawn = small.file_gaussians, left_out.rows, compacted
    return np.stack([left_out.shares, *(left_out.score(gaussians) for gaussians in drawn)])


def views_around(cameras: Cameras, views: Sequence[int], most: int) -> list[int]:
    """Choose ``views`` and those whose cameras are nearest to any of them, at most ``most`` in all; sorted."""
    distances = camera_distances(cameras)[list(views)].min(0)
    distances[list(views)] = -1.0
    return sorted(np.argsort(distances, kind="stable")[:most].tolist())


def shrink_scene(scene: PicturedScene, step: int) -> PicturedScene:
    """Shrink the pictures by a factor ``step`` per side; each new pixel keeps one front Gaussian, of larger scales."""
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
    rows = fronts[fronts >= 0]
    gaussians = scene.gaussians[rows]
    return replace(
        scene, cameras=replace(cameras, Ks=Ks, width=width, height=height), images=images, masks=masks,
        empty=empty, importance=importance, large_photos=None,
        gaussians=replace(gaussians, scales=gaussians.scales * np.float32(step)), pixels=Pixels.of_grid(fronts >= 0),
        filled=None if scene.filled is None else scene.filled[rows],
    )  # fmt: skip
