"""The input as it is."""

from __future__ import annotations

from gsmerge.baselines.baseline import Baseline, own_gaussians
from gsmerge.build import Source
from gsmerge.options import CompactOptions
from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.group import Canvas
from gsmerge.types import Gaussians


def run(source: Source, canvas: Canvas, options: CompactOptions, count: int, log: RunLog) -> Gaussians:
    """All Gaussians, whatever the count."""
    return own_gaussians(source)


UNMERGED = Baseline("unmerged", "the input as it is", run, uses=())
