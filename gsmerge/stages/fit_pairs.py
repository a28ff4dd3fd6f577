"""Merged pairs -> fitted: fit a scene that no photo shows to renders of the scene itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsmerge.facts.prepare import Prepared
from gsmerge.fit import Fitted, fit_scene
from gsmerge.raster.photos import scene_photos, score_photos
from gsmerge.runtime.record import note, stage
from gsmerge.settings.fit import FitOptions
from gsmerge.types import Decoded, Gaussians

FITTED = 16  # views of each kind for a fit without cameras, and half as many on a walk
FITTED_LONG, LONG = 48, 600  # views of each kind for a long fit; a fit is long from LONG steps on


def fit_pairs(starts: Sequence[Decoded], prepared: Prepared, options: FitOptions, seed: int) -> Fitted:
    """Fit the best of several starts to renders of the input.

    If the scene has no views of its own, each start is fitted, and the best result is returned.
    """
    photos, views = scene_photos(prepared.scene), prepared.reference.score_views
    psnrs = [score_photos(start.gaussians, photos, views, every=4).psnr for start in starts]
    best = int(np.argmax(psnrs))
    if options.fit == "none":
        return unfitted(starts[best], prepared)
    if prepared.reference.placed:
        return fit_to_placed(starts, best, prepared, options, seed)
    return fit_around(starts[best], prepared, options, seed)


def unfitted(start: Decoded, prepared: Prepared) -> Fitted:
    """Return a start as the result of a fit that was not made."""
    return Fitted(start.gaussians, prepared.scene.cameras, None)


def fit_around(start: Decoded, prepared: Prepared, options: FitOptions, seed: int) -> Fitted:
    """Fit a start to renders of the scene's own views; a long fit also uses renders of views around them."""
    scene = prepared.scene_around if options.grows else prepared.scene
    fitted = fit_scene(start, scene, options, seed, num_scored=len(prepared.scene))
    accepted = fitted.report is not None and fitted.report.accepted
    gaussians = fitted.gaussians if accepted else start.gaussians
    return replace(fitted, gaussians=gaussians, cameras=prepared.scene.cameras)


@stage("fit")
def fit_to_placed(starts: Sequence[Decoded], best: int, prepared: Prepared, options: FitOptions, seed: int) -> Fitted:
    """Fit each start to renders from placed views, and return the result with the best score in held-out views.

    ``best`` is the start with the best score before the fits. It is returned unfitted, with a note, if no fit was
    accepted, or if the best fit does not gain on average.
    """
    scene = prepared.scene_placed(FITTED_LONG if options.steps >= LONG else FITTED)
    placed = range(len(prepared.scene), len(scene))
    fits = [fit_scene(start, scene, options, seed, views=placed, num_scored=len(placed)) for start in starts]
    accepted = [fit.report is not None and fit.report.accepted for fit in fits]
    after = [score_views(fit.gaussians, prepared) for fit in fits]
    if any(accepted):
        best = int(np.argmax([psnrs.mean() for psnrs in after]))
    gains = after[best] - score_views(starts[best].gaussians, prepared)
    if accepted[best] and gains.mean() > 0:
        return replace(fits[best], cameras=prepared.scene.cameras)
    note("there is no fit, because a fit to placed views shows held-out views worse; --cameras allows a better fit")
    return unfitted(starts[best], prepared)


def score_views(gaussians: Gaussians, prepared: Prepared) -> np.ndarray:
    """Return the PSNR (dB) ``[v]`` of each scored view."""
    photos = scene_photos(prepared.scene)
    return np.array([score_photos(gaussians, photos, [view]).psnr for view in prepared.reference.score_views])
