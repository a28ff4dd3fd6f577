"""Baselines: the methods of the entry points ``gsmerge.methods`` that come with the package."""

from __future__ import annotations

from gsmerge.compaction.methods import Method
from gsmerge.fit import FitOptions
from gsmerge.research.baselines import greedy, simple, voxel
from gsmerge.settings.setting import flat_settings

FULL_FIT_SETTINGS = ("effort", "poses", *(name for name in flat_settings(FitOptions) if name != "fit"))

UNMERGED = Method("unmerged", simple.unmerged, uses=())
UNMERGED_FIT = Method("unmerged-fit", simple.unmerged_fit, needs=("photos",), uses=FULL_FIT_SETTINGS)
MOMENT_MATCHING = Method("moment-matching", simple.match_moments)
VOXEL = Method("voxel", voxel.run)
OPACITY = Method("opacity", simple.prune_by_opacity)
CONTRIBUTION = Method("contribution", simple.prune_by_contribution)
RANDOM = Method("random", simple.prune_at_random)
BLOCKS = Method("blocks", simple.merge_blocks, needs=("pixels",))
GREEDY = Method("greedy", greedy.run)
SPLAT_TRANSFORM = Method("splat-transform", simple.splat_transform, check=simple.find_program)
