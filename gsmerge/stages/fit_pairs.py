"""Merged pairs -> fitted Gaussians: fit a scene without photos to renders of the scene itself."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from gsmerge.facts.prepare import Prepared
from gsmerge.fit import Fitted, fit_scene
from gsmerge.raster.photos import scene_photos, score_photos
from gsmerge.runtime.record import record_part
from gsmerge.settings.fit import FitOptions
from gsmerge.stages.pair_merge import POWERS, merge_neighbors
from gsmerge.types import Decoded

SHORT = 60  # steps of the short fits by which the better one of two starts is chosen
# If all Gaussians stay, the step sizes of a fit to renders are this share of the usual ones, because the start is close
# to the renders. If fewer stay, they are farther apart, and steps are larger by the root of the ratio of the numbers
RENDERS_STEP = 0.09


def choose_power(count: int, prepared: Prepared, options: FitOptions, seed: int) -> float:
    """Choose which of ``POWERS`` weighs masses in the costs of merging: the one whose Gaussians show the views best.

    Each power is tried by a short fit, and judged by the median PSNR of the views.
    """
    photos = scene_photos(prepared.scene)
    tuning = replace(options.tuning, outside_from=1.0)  # no steps for views from outside, which are not scored
    short = replace(options, fit_steps=min(options.steps, SHORT), tuning=tuning)

    def score(power: float) -> float:
        with record_part(silent=True):
            start = merge_scene(count, power, prepared)
            gaussians = fit_around(start, prepared, short, seed).gaussians
        psnrs = [score_photos(gaussians, photos, [view], every=4).psnr for view in range(len(photos))]
        return float(np.median(psnrs))

    return max(POWERS, key=score) if count < len(prepared.scene.gaussians) else POWERS[0]


def merge_scene(count: int, power: float, prepared: Prepared) -> Decoded:
    """Merge the Gaussians of a scene pair by pair into ``count``, which are the start of a fit."""
    gaussians = merge_neighbors(prepared.scene.gaussians, count, power)
    return Decoded(gaussians, count, exact=True, is_input=gaussians is prepared.scene.gaussians)


def fit_around(start: Decoded, prepared: Prepared, options: FitOptions, seed: int) -> Fitted:
    """Fit a start to renders of the scene; a long fit also uses renders from cameras around the scene's own views.

    If all views of the scene were placed, those on which the fit is scored take no part in it. If the fit makes most
    views worse, the start is returned.
    """
    share = len(start.gaussians) / len(prepared.scene.gaussians)
    options = replace(options, tuning=options.tuning.scaled(min(1.0, RENDERS_STEP / math.sqrt(share))))
    scene, reference = prepared.scene_around if options.grows else prepared.scene, prepared.reference
    held_out = reference.score_views if reference.placed else ()
    views = [view for view in range(len(scene)) if view not in held_out]
    num_own = len(prepared.scene) - len(held_out)
    fitted = fit_scene(start, scene, options, seed, views=views, num_scored=num_own, held_out=held_out)
    accepted = fitted.report is not None and fitted.report.accepted
    gaussians = fitted.gaussians if accepted else start.gaussians
    return replace(fitted, gaussians=gaussians, cameras=prepared.scene.cameras)
