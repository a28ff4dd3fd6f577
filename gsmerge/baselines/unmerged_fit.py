"""The input after the full fit that ours gets: what merging has to be better than."""

from __future__ import annotations

from dataclasses import asdict, fields, replace

from gsmerge.baselines.baseline import Baseline, own_gaussians
from gsmerge.build import Source
from gsmerge.fit import FitOptions, fit
from gsmerge.grouping import Canvas
from gsmerge.journal import Journal
from gsmerge.options import CompactOptions
from gsmerge.photos import scene_photos
from gsmerge.types import Gaussians


def fitted_input(source: Source, settings: FitOptions, seed: int, journal: Journal) -> Gaussians:
    """All Gaussians, fitted to the photos; those that no photo shows make way for others, so the number stays."""
    gaussians = own_gaussians(source)
    with journal.stage("fit"):
        photos = scene_photos(source.scene), scene_photos(source.scene, 2)
        gaussians, report = fit(gaussians, photos, settings, len(gaussians), seed, journal.fit_progress)
    if report:
        journal.choices["fit"] = asdict(report)
        if not report.accepted:
            journal.notes.append("the fit was not accepted: held-out parts of the photos did not get better")
    return gaussians


def run(source: Source, canvas: Canvas, options: CompactOptions, count: int, journal: Journal) -> Gaussians:
    """As many steps as ours by default, as much time with a time budget; whatever the count."""
    return fitted_input(source, replace(options.fit, fit="full"), options.seed, journal)


UNMERGED_FIT = Baseline(
    "unmerged-fit",
    "the input after the same full fit",
    run,
    needs=("photos",),
    uses=tuple(f.name for f in fields(FitOptions) if f.name != "fit"),
)
