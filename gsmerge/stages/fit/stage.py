"""The stage: which Gaussians stay, and what of them is fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.render import contributions, plan_view, prepare
from gsmerge.render.photos import Photos, photo_errors
from gsmerge.runtime.threads import in_turn
from gsmerge.stages.fit.color import draw, fit_colors
from gsmerge.stages.fit.full import Progress, fit_full
from gsmerge.stages.fit.grow import grow_to
from gsmerge.stages.fit.options import FitOptions
from gsmerge.stages.fit.report import FitReport
from gsmerge.stages.fit.state import gaussians_of, start_state
from gsmerge.types import Gaussians

CLOSE = 1.0  # dB that the held-out blocks must gain; after less, the whole photos are compared
ALWAYS = float("inf")  # where the full fit failed: it may have begun where another one ended
START = 0.57  # share of the Gaussians that a run which grows begins with


def fit(
    gaussians: Gaussians,
    photos: tuple[Photos, ...],
    options: FitOptions,
    count: int = 0,
    seed: int = 0,
    progress: Progress | None = None,
    baseline_start: Gaussians | None = None,
    *,
    exact: bool = False,
) -> tuple[Gaussians, FitReport | None]:
    """Leave out what no photo shows, and fit the rest to the photos; a draft without a fit leaves out nothing.

    Where the full fit does not make held-out parts of the photos better, the colour fit is tried.

    Args:
        gaussians: Canonical Gaussians.
        photos: The input views, see :func:`gsmerge.stages.fit.fit_photos`. Larger ones are fitted to on the CPU alone.
        options: What to fit.
        count: Number of Gaussians that the full fit may grow to.
        seed: Everything random.
        progress: Called after every step of the full fit.
        baseline_start: Another start that the full fit may beat instead, see
            :func:`gsmerge.stages.fit.full.score_to_beat`.
        exact: Whether ``count`` is to be met: where nothing grows to it, nothing is left out either.

    Returns:
        The Gaussians that stay, fitted, and what was done; None if nothing was asked for.
    """
    device = "cpu" if len(photos) > 2 else _device(options, photos[0])
    if device != "cpu":
        from gsmerge.gpu.fit import fit_gaussians  # torch; it stands above all stages, and is loaded for its use alone

        pair = photos[0], photos[1]
        return fit_gaussians(
            gaussians, pair, options, count, seed, progress, baseline_start, exact=exact, device=device
        )
    if exact and not options.grows:
        options = replace(options, min_contribution=0.0)
    if not options.needs_photos:  # it costs as much as all that was done before
        return gaussians, None
    keep = visible_mask(gaussians, photos[1], options.min_contribution)
    if options.fit == "none":
        return gaussians[keep], None
    if options.fit == "full":
        kept = gaussians[keep]
        fitted, report = fit_full(kept, photos, options, count, seed, progress, None, baseline_start)
        fitted, report = _better_of(kept, fitted, report, photos[0])
        if report.accepted:
            return fitted, report
        if options.grows:  # the stages before left room for a growth that did not happen
            state = grow_to(start_state(kept), photos[1], count)
            grown = gaussians_of(state.x, state.splats.shN)
            fitted, report = fit_colors(grown, draw(grown, photos[1]), photos[1], options, seed)
            return _better_of(kept, fitted, report, photos[0], ALWAYS) if report.accepted else (kept, report)
    fitted, report = fit_colors(gaussians, draw(gaussians, photos[1]), photos[1], options, seed)
    return _better_of(gaussians[keep], fitted[keep], report, photos[0], ALWAYS if options.fit == "full" else CLOSE)


def _device(options: FitOptions, photos: Photos) -> str:
    """Where a fit to some photos runs, ``"cpu"`` or ``"cuda"``."""
    if options.device == "cpu":
        return "cpu"
    from gsmerge.render.cuda import chosen_device

    return chosen_device(options.device, len(photos) * photos.height * photos.width)


def visible_mask(gaussians: Gaussians, photos: Photos, min_weight: float) -> np.ndarray:
    """``[n]`` mask of the Gaussians worth keeping.

    Args:
        gaussians: n Gaussians.
        photos: The views that they may show in.
        min_weight: Least blending weight at some pixel. What lies in no photo's frustum stays.
    """
    splats = prepare(gaussians)

    def one_view(view: int) -> tuple[np.ndarray, np.ndarray]:
        plan = plan_view(splats, **photos.camera(view))
        return plan.ids, contributions(plan)[1]

    peak, inside = np.zeros(len(gaussians), np.float32), np.zeros(len(gaussians), bool)
    for ids, peaks in in_turn(one_view, range(len(photos))):
        inside[ids] = True
        np.maximum(peak, peaks, out=peak)
    return ~inside | (peak >= min_weight)


def _better_of(
    before: Gaussians, after: Gaussians, report: FitReport, photos: Photos, close: float = CLOSE
) -> tuple[Gaussians, FitReport]:
    """The fitted Gaussians; their start if the held-out blocks hardly gained and the photos as a whole lost.

    Gaussians that were fitted already are where steps of the default size only scatter. After a gain of ``close`` dB or
    more the photos are not compared.
    """
    if not report.accepted or report.holdout_after - report.holdout_before >= close:
        return after, report
    if _photos_error(after, photos) <= _photos_error(before, photos):
        return after, report
    return before, replace(report, method="none", accepted=False, stopped="the photos as a whole were shown worse")


def _photos_error(gaussians: Gaussians, photos: Photos) -> float:
    """Mean squared error of all photos."""

    def score(view: int, image: np.ndarray, _: np.ndarray) -> float:
        return float(((np.clip(image, 0, 1) - photos.images[view]) ** 2).mean(dtype=np.float64))

    return float(np.mean(photo_errors(gaussians, photos, score)))


def start_share(options: FitOptions) -> float:
    """Share of the Gaussians asked for that the stages before the fit should leave for it to begin with."""
    return START if options.grows else 1.0
