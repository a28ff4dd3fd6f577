"""The stage: which Gaussians stay, and what of them is fitted."""

from __future__ import annotations

from gsmerge.fit.color import draw, fit_colors, seen
from gsmerge.fit.device import engine_for
from gsmerge.fit.full import Progress, fit_full
from gsmerge.fit.grow import grow_to
from gsmerge.fit.options import FitOptions
from gsmerge.fit.report import FitReport
from gsmerge.fit.state import gaussians_of, start_state
from gsmerge.photos import Photos
from gsmerge.types import Gaussians

START = 0.57  # share of the Gaussians that a run which grows begins with


def fit(
    gaussians: Gaussians,
    photos: tuple[Photos, Photos],
    options: FitOptions,
    count: int = 0,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[Gaussians, FitReport | None]:
    """Leave out what no photo shows, and fit the rest to the photos.

    Where the full fit does not make held-out parts of the photos better, the colour fit is tried.

    Args:
        gaussians: Canonical Gaussians.
        photos: The input views at full and at half size.
        options: What to fit.
        count: Number of Gaussians that the full fit may grow to.
        seed: Everything random.
        progress: Told after every step of the full fit.

    Returns:
        The Gaussians that stay, fitted, and what was done; None if nothing was asked for.
    """
    drawn = draw(gaussians, photos[1])
    keep = seen(drawn, options.prune)
    if options.fit == "none":
        return gaussians[keep], None
    if options.fit == "full":
        kept = gaussians[keep]
        fitted, report = fit_full(kept, photos, options, count, seed, progress, engine_for(options.device))
        if report.accepted:
            return fitted, report
        if options.grows:  # the stages before left room for a growth that did not happen
            state = grow_to(start_state(kept), photos[1], count)
            grown = gaussians_of(state.x, state.splats.shN)
            fitted, report = fit_colors(grown, draw(grown, photos[1]), photos[1], options, seed)
            return (fitted if report.accepted else kept), report
    gaussians, report = fit_colors(gaussians, drawn, photos[1], options, seed)
    return gaussians[keep], report


def start_share(options: FitOptions) -> float:
    """Share of the Gaussians asked for that the stages before the fit should leave for it to begin with."""
    return START if options.grows else 1.0
