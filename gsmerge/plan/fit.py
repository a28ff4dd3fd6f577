"""Decide the fit: its steps, and what depends on the pictures."""

from __future__ import annotations

import math

from gsmerge.frozen import replace
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.facts.scene_size import SceneSize
from gsmerge.method.fit import photo_scale
from gsmerge.method.stages.limits import CountLimits
from gsmerge.plan.efforts import EFFORTS
from gsmerge.runtime.record import note
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.fit import GROW_ROUNDS, GROW_STEPS, USUAL_SHARE, FitOptions

AUTO_STEPS = 2  # with budget auto, steps relative to the usual number: few Gaussians need more steps
MOST_STEPS = 2.0  # most steps for more than the usual share of Gaussians per pixel, relative to the usual steps
USUAL_VIEWS = 12  # views up to which the steps of an effort are enough
NO_FIT = "without cameras a draft has no fit: --effort fast has one"


def resolve_fit(options: CompactOptions, size: SceneSize, limits: CountLimits) -> FitOptions:
    """Fill in the settings of the fit that depend on effort and size.

    In a draft without a fit, Gaussians that no photo shows are kept. A draft of a scene without views has no fit.
    """
    fit = options.fit
    effort = EFFORTS[options.effort]
    views = size.num_views
    if views == 0 and fit.fit_steps is None and not effort.fits_alone:
        fit = replace(fit, fit="none")
    prunes = fit.fit != "none" or effort.prunes
    share = limits.share if fit.share is None and views else fit.share
    return replace(
        fit,
        fit_steps=steps_for(options, views, USUAL_SHARE if share is None else share),
        share=share,
        grow_steps=max(GROW_STEPS, GROW_ROUNDS * views),
        min_contribution=fit.min_contribution if prunes else 0.0,
    )


def steps_for(options: CompactOptions, num_views: int, share: float = USUAL_SHARE) -> int:
    """Return the number of steps of the full fit.

    Unless the options state it, the number follows from effort, number of views and ``share``, the result's number of
    Gaussians per pixel. A step draws one view. Measurements are in docs/internals/large-scenes.md.
    """
    if options.fit.fit_steps is not None:
        return options.fit.fit_steps
    steps = EFFORTS[options.effort].steps * math.sqrt(max(1.0, num_views / USUAL_VIEWS))
    if options.budget.auto:
        return round(AUTO_STEPS * steps)
    return round(min(max(1.0, math.sqrt(share / USUAL_SHARE)), MOST_STEPS) * steps)


def fit_to_pictures(prepared: Prepared, options: CompactOptions, fit: FitOptions, *, merges_pairs: bool) -> FitOptions:
    """Fill in the settings of the fit that depend on the pictures and on other options.

    These settings are the scale of the photos, and whether the fit moves cameras, fills the budget, and keeps Gaussians
    beyond all views. If pairs are merged, the fit is to renders of the input. It allows long thin Gaussians, because
    the input may have them, and is not scored on held-out patches. Gaussians beyond all views, and Gaussians that
    hardly show in any view, are kept, because they belong to the scene.
    """
    scale = 1.0
    moves = False
    if fit.fit != "none":
        scale, problem = photo_scale(prepared.scene, fit, auto=EFFORTS[options.effort].large_photos)
        if problem is not None:
            note(problem)
        is_free = options.prepare.poses == "free" or (options.prepare.poses == "auto" and prepared.moved)
        moves = is_free and fit.fit == "full" and prepared.reference.of_views
    fit = replace(
        fit, photo_scale=scale, move_cameras=moves, beyond=options.prepare.extent == "beyond",
        fills=options.budget.is_filled,
    )  # fmt: skip
    if not merges_pairs:
        return fit
    if prepared.reference.placed and fit.fit == "none" and options.fit.fit != "none":
        note(NO_FIT)
    tuning = replace(fit.tuning, max_ratio=math.inf)
    return replace(fit, scored=False, beyond=True, fills=True, min_contribution=0.0, tuning=tuning)
