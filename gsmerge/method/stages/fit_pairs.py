"""Merged pairs -> fitted Gaussians: fit a scene without photos to renders of the scene itself."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.fit import Fitted, fit_scene
from gsmerge.method.raster.photos import scene_photos, score_photos
from gsmerge.method.stages.pair_merge import POWERS, merge_neighbors
from gsmerge.runtime.record import record_part
from gsmerge.settings.fit import FitOptions
from gsmerge.types import Decoded

SHORT = 60  # steps of the short fits that decide between two starts
# Step sizes of a fit to renders, as a share of the usual ones, if all Gaussians stay. The steps are small, because the
# start is close to the renders. If only a share of the Gaussians stays, step sizes are divided by the root of this
# share
RENDERS_STEP = 0.09


def choose_power(count: int, prepared: Prepared, options: FitOptions, seed: int) -> float:
    """Choose one of the ``POWERS``, so that merged Gaussians show the views best after a short fit.

    The costs of merging Gaussians are multiplied by the masses to the chosen power.
    """
    photos = scene_photos(prepared.scene)
    tuning = replace(options.tuning, outside_from=1.0)  # no steps for views from outside, which are not scored
    short = replace(options, fit_steps=min(options.steps, SHORT), tuning=tuning)

    def score(power: float) -> float:
        """Return the median PSNR (dB) of the views after a short fit."""
        with record_part(silent=True):
            start = merge_scene(count, power, prepared)
            gaussians = fit_around(start, prepared, short, seed).gaussians
        psnrs = [score_photos(gaussians, photos, [view], every=4).psnr for view in range(len(photos))]
        return float(np.median(psnrs))

    return max(POWERS, key=score) if count < len(prepared.scene.gaussians) else POWERS[0]


def merge_scene(count: int, power: float, prepared: Prepared) -> Decoded:
    """Merge the Gaussians of a scene pair by pair into ``count`` Gaussians, from which a fit starts."""
    gaussians = merge_neighbors(prepared.scene.gaussians, count, power)
    return Decoded(gaussians, count, exact=True, is_input=gaussians is prepared.scene.gaussians)


def fit_around(start: Decoded, prepared: Prepared, options: FitOptions, seed: int) -> Fitted:
    """Fit Gaussians to renders of the scene from its views and, in a long fit, from cameras around the views.

    If the scene has no cameras, some are placed, and the placed views that score the fit are left out of it. If the fit
    makes most views worse, its start is returned.
    """
    share = len(start.gaussians) / len(prepared.scene.gaussians)
    options = replace(options, tuning=options.tuning.scaled(min(1.0, RENDERS_STEP / math.sqrt(share))))
    scene = prepared.scene_around if options.grows else prepared.scene
    reference = prepared.reference
    held_out = reference.score_views if reference.placed else ()
    views = [view for view in range(len(scene)) if view not in held_out]
    num_own = len(prepared.scene) - len(held_out)
    fitted = fit_scene(start, scene, options, seed, views=views, num_scored=num_own, held_out=held_out)
    accepted = fitted.report is not None and fitted.report.accepted
    gaussians = fitted.gaussians if accepted else start.gaussians
    return replace(fitted, gaussians=gaussians, cameras=prepared.scene.cameras)
