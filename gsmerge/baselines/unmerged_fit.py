"""The input after the full fit that ours gets: what merging has to be better than."""

from __future__ import annotations

from dataclasses import asdict, fields, replace

from gsmerge.baselines.baseline import Baseline, own_gaussians
from gsmerge.build import Source
from gsmerge.options import CompactOptions
from gsmerge.render.photos import scene_photos
from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.fit import FitOptions, fit
from gsmerge.stages.group import Canvas
from gsmerge.types import Gaussians


def fitted_input(source: Source, settings: FitOptions, seed: int, log: RunLog) -> Gaussians:
    """All Gaussians, fitted to the photos; those that no photo shows make way for others, so the number stays."""
    gaussians = own_gaussians(source)
    with log.stage("fit"):
        photos = scene_photos(source.scene), scene_photos(source.scene, 2)
        gaussians, report = fit(gaussians, photos, settings, len(gaussians), seed, log.fit_progress)
    if report:
        log.choices["fit"] = asdict(report)
        if not report.accepted:
            log.notes.append("the fit was not accepted: held-out parts of the photos did not get better")
    return gaussians


def run(source: Source, canvas: Canvas, options: CompactOptions, count: int, log: RunLog) -> Gaussians:
    """As many steps as ours by default, as much time with a time budget; whatever the count."""
    return fitted_input(source, replace(options.fit, fit="full"), options.seed, log)


UNMERGED_FIT = Baseline(
    "unmerged-fit",
    "the input after the same full fit",
    run,
    needs=("photos",),
    uses=tuple(f.name for f in fields(FitOptions) if f.name != "fit"),
)
