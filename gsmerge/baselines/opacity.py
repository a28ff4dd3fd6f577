"""Pruning by opacity."""

from __future__ import annotations

from gsmerge.allocate import trim
from gsmerge.baselines.baseline import Baseline, own_gaussians
from gsmerge.build import Source
from gsmerge.grouping import Canvas
from gsmerge.journal import Journal
from gsmerge.options import CompactOptions
from gsmerge.types import Gaussians


def run(source: Source, canvas: Canvas, options: CompactOptions, count: int, journal: Journal) -> Gaussians:
    """The most opaque, unchanged and in their order; of equal ones the first of the file."""
    gaussians = own_gaussians(source)
    with journal.stage("reduce"):
        return gaussians[trim(gaussians.opacities, count)]


OPACITY = Baseline("opacity", "keep the most opaque", run)
