"""Pruning by opacity."""

from __future__ import annotations

from gsmerge.baselines.baseline import Baseline, own_gaussians
from gsmerge.build import Source
from gsmerge.options import CompactOptions
from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.group import Canvas
from gsmerge.stages.region_tree import trim
from gsmerge.types import Gaussians


def run(source: Source, canvas: Canvas, options: CompactOptions, count: int, log: RunLog) -> Gaussians:
    """The most opaque, unchanged and in their order; of equal ones the first of the file."""
    gaussians = own_gaussians(source)
    with log.stage("reduce"):
        return gaussians[trim(gaussians.opacities, count)]


OPACITY = Baseline("opacity", "keep the most opaque", run)
