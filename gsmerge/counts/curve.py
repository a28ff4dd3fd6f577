"""Measure the scene's curve, and choose a number of Gaussians by it.

The curve is the quality of short fits by their number of Gaussians. The quality is measured on photos that the fits
leave out or, with too few photos, on patches that the fits leave out. The chosen number is at the knee of the curve, or
the smallest that is good enough.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.fit.photo_sizes import holdout_psnr, training_weights
from gsmerge.method.kernels.elementary import log, power
from gsmerge.method.pipelines.build import build
from gsmerge.method.pipelines.plan import Plan
from gsmerge.method.raster.metrics import WINDOW, ssim
from gsmerge.method.raster.photos import Photos, render_photos, scene_photos
from gsmerge.results.left_out import LEAST_SEEN, LeftOut
from gsmerge.runtime.record import begin_part, record_part, report_progress
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Gaussians

PROGRESS = "curve: what each count brings"
SSIM_DB = 40.0  # dB that equal 1 of SSIM. SSIM is needed, because 1 % of the Gaussians may beat 4 % in PSNR but blur
KNEE_SLOPE = 0.15  # dB of quality per doubling of the count; below it, more Gaussians gain too little


@dataclass(frozen=True)
class CurvePoint:
    """Quality of a short fit with ``count`` Gaussians, measured on held-out photos or patches."""

    count: int  # Gaussians
    psnr: float  # dB
    ssim: float  # Structural similarity

    @property
    def quality(self) -> float:
        """PSNR + 40 SSIM, dB."""
        return self.psnr + SSIM_DB * self.ssim


def curve_counts(max_drop: float | None, usual: int, least: int, most: int) -> tuple[list[int], int]:
    """Return the counts at which a curve is measured, ascending, and the steps of its short fits.

    The counts lie around the ``usual`` count, between ``least`` and ``most``. ``max_drop`` is the largest loss of
    quality (dB) that is allowed on the curve; None: the knee of the curve decides the number.
    """
    # shares of the usual count; this is enough to find the knee
    shares = [1 / 8, 1 / 4, 1 / 2, 1.0]
    steps = 60
    if max_drop is not None:
        # a loss may be a tenth of a dB, which shorter fits do not show
        shares = [1 / 16, *shares, 2.0]
        steps = 300
    return sorted({min(max(round(usual * share), least), most) for share in shares}), steps


def measure_curve(
    prepared: Prepared, plan: Plan, steps: int, counts: Sequence[int], left_out: LeftOut | None = None
) -> list[CurvePoint]:
    """Measure PSNR and SSIM, at full size, of short fits with each of the ``counts``.

    Every fit takes ``steps`` steps, also if the plan has another number. Each fit is scored on the photos of
    ``left_out`` or, without them, on patches of all photos that the fit leaves out.
    """
    holdout = 0.1  # share of the photos' patches that the fits leave out
    short = replace(
        plan.fit, fit="full", fit_steps=steps, half_res_share=1.0, holdout=holdout, photo_scale=1.0,
        scored=True, move_cameras=False, share=None,
    )  # fmt: skip
    if left_out is None:
        photos = scene_photos(prepared.scene)[prepared.reference.score_views]
        weights = training_weights(photos, holdout, plan.seed)
        min_gain = short.tuning.min_gain
    else:
        seen = np.flatnonzero(left_out.shares > LEAST_SEEN).tolist()
        photos = left_out.photos[seen]
        weights = [1 - mask.astype(np.float32) for mask in left_out.seen[seen]]
        prepared = left_out.rest
        plan = left_out.plan(plan)
        min_gain = math.inf
    short_plan = plan.with_fit(short)
    short_plan = replace(short_plan, merge=replace(short_plan.merge, checkpoint=None))
    points: list[CurvePoint] = []
    report_progress(PROGRESS, 0, len(counts))
    for count in counts:
        begin_part("curve")
        with record_part(silent=True):
            gaussians = build(prepared, short_plan, left_out.reduce(count) if left_out else count).gaussians
        points.append(_score_fit(count, gaussians, photos, weights, min_gain))
        report_progress(PROGRESS, len(points), len(counts))
    return points


def _score_fit(
    count: int, gaussians: Gaussians, photos: Photos, weights: list[np.ndarray], min_gain: float
) -> CurvePoint:
    """Score a fit on the pixels of the photos that it left out, which have a weight of 0."""
    images = [np.clip(image, 0, 1) for image in render_photos(gaussians, photos)]
    views = range(len(photos))
    similarities = parallel_map(lambda v: _measure_ssim(images[v], photos.images[v], weights[v] == 0), views)
    return CurvePoint(count, holdout_psnr(images, photos, weights, min_gain), float(np.mean(similarities)))


def _measure_ssim(image: np.ndarray, photo: np.ndarray, mask: np.ndarray) -> float:
    """Return the SSIM over the windows inside the mask, or over the whole picture if no window lies inside.

    The SSIM of a picture that is smaller than a window is 0.
    """
    if min(mask.shape) < WINDOW:
        return 0.0
    border = WINDOW // 2
    return ssim(image, photo, mask if mask[border:-border, border:-border].any() else None)


def count_within(points: Sequence[CurvePoint], max_drop: float) -> int:
    """Return the fewest Gaussians whose quality lies at most ``max_drop`` dB below the best of the curve.

    The points are sorted by count.
    """
    best = max(point.quality for point in points)
    return count_reaching([(point.count, point.quality) for point in points], best - max_drop)


def count_reaching(points: Sequence[tuple[int, float]], target: float) -> int:
    """Return the fewest Gaussians at which a curve of points (count, quality), sorted by count, reaches ``target``.

    Between two points the quality is linear in the logarithm of the count. At least one point has to reach the target.
    """
    index = next(i for i, (_, quality) in enumerate(points) if quality >= target)
    if index == 0:
        return points[0][0]
    (low_count, low), (high_count, high) = points[index - 1 : index + 1]
    return math.ceil(low_count * float(power(high_count / low_count, (target - low) / (high - low))))


def curve_knee(points: Sequence[CurvePoint]) -> int:
    """Return the number beyond which further Gaussians add little quality.

    The knee of the curve is the last count at which the quality grows by at least 0.15 dB per doubling of the count.
    Halfway between two neighbouring points, the slope of the curve is that of the line through both points. Elsewhere
    the slope is interpolated. The points are sorted by count.
    """
    doublings = [float(log(p.count) / log(2)) for p in points]
    pairs = list(pairwise(range(len(points))))
    middles = [(doublings[a] + doublings[b]) / 2 for a, b in pairs]
    slopes = [(points[b].quality - points[a].quality) / max(doublings[b] - doublings[a], 1e-9) for a, b in pairs]
    last_steep = max((i for i, slope in enumerate(slopes) if slope >= KNEE_SLOPE), default=None)
    if last_steep is None:
        return points[0].count
    if last_steep == len(slopes) - 1:
        return points[-1].count
    share = (slopes[last_steep] - KNEE_SLOPE) / (slopes[last_steep] - slopes[last_steep + 1])
    return round(float(power(2, middles[last_steep] + share * (middles[last_steep + 1] - middles[last_steep]))))
