"""The stage: which Gaussians stay, and what of them is fitted."""

from __future__ import annotations

from gsmerge.fit.color import draw, fit_colors, seen
from gsmerge.fit.full import Progress, fit_full
from gsmerge.fit.options import FitOptions
from gsmerge.fit.report import FitReport
from gsmerge.photos import Photos
from gsmerge.types import Gaussians


def fit(
    gaussians: Gaussians,
    photos: tuple[Photos, Photos],
    options: FitOptions,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[Gaussians, FitReport | None]:
    """Leave out what no photo shows, and fit the rest to the photos.

    Where the full fit does not make held-out parts of the photos better, the colour fit is tried.

    Args:
        gaussians: Canonical Gaussians.
        photos: The input views at full and at half size.
        options: What to fit.
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
        fitted, report = fit_full(kept, photos, options, seed, progress)
        if report.accepted:
            return fitted, report
    gaussians, report = fit_colors(gaussians, drawn, photos[1], options, seed)
    return gaussians[keep], report
