"""Gaussians -> fitted Gaussians: all parameters, or colours alone, against the input photos."""

from gsmerge.fit.cpu import ON_CPU
from gsmerge.fit.engine import FitBackend
from gsmerge.fit.photo_sizes import fit_photos, photo_scale
from gsmerge.fit.report import FitReport, Fitted, record_fit, report_steps
from gsmerge.fit.schedule import FitJob
from gsmerge.fit.stage import fit, fit_scene, run_on, start_share
from gsmerge.fit.survey import peak_weights, visible_mask
from gsmerge.settings.fit import FitOptions

__all__ = [
    "ON_CPU", "FitBackend", "FitJob", "FitOptions", "FitReport", "Fitted", "fit", "fit_photos", "fit_scene",
    "peak_weights", "photo_scale", "record_fit", "report_steps", "run_on", "start_share", "visible_mask",
]  # fmt: skip
