"""Gaussians -> fitted Gaussians: optimise all parameters, so that renders look like the input photos."""

from gsmerge.method.fit.photo_sizes import fit_photos, photo_scale
from gsmerge.method.fit.report import FitReport, Fitted, record_fit, report_steps
from gsmerge.method.fit.schedule import FitJob
from gsmerge.method.fit.stage import fit_gaussians, fit_scene, start_share
from gsmerge.method.fit.survey import peak_weights
from gsmerge.settings.fit import FitOptions

__all__ = [
    "FitJob", "FitOptions", "FitReport", "Fitted", "fit_gaussians", "fit_photos", "fit_scene",
    "peak_weights", "photo_scale", "record_fit", "report_steps", "start_share",
]  # fmt: skip
