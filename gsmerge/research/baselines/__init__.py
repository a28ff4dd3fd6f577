"""Baselines: the methods of the entry points ``gsmerge.methods`` that come with the package."""

from __future__ import annotations

from functools import partial

from gsmerge.io.formats.splat_transform import find_program
from gsmerge.method.fit import FitOptions
from gsmerge.plugin import Method, prepare, without
from gsmerge.research.baselines import greedy, simple
from gsmerge.settings.setting import flat_settings

FULL_FIT_SETTINGS = ("effort", "poses", *(name for name in flat_settings(FitOptions) if name != "fit"))

_UNFILLED = without("holes", "scored views")  # baselines use only the Gaussians of the file
_baseline = partial(Method, prepare=partial(prepare, steps=_UNFILLED))

UNMERGED = _baseline("unmerged", simple.unmerged, uses=())
UNMERGED_FIT = _baseline("unmerged-fit", simple.unmerged_fit, needs_photos=True, uses=FULL_FIT_SETTINGS)
MOMENT_MATCHING = _baseline("moment-matching", simple.match_moments)
OPACITY = _baseline("opacity", simple.prune_faintest)
RANDOM = _baseline("random", simple.prune_at_random)
GREEDY = _baseline("greedy", greedy.reduce_to_count)
SPLAT_TRANSFORM = _baseline("splat-transform", simple.splat_transform, check=find_program)
