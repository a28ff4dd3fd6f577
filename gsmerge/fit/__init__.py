"""Gaussians -> fitted Gaussians: all parameters, or colours alone, against the input photos."""

from gsmerge.fit.fit_options import Fit, FitOptions, FitReport, Fitted, Tuning, record_fit, report_steps
from gsmerge.fit.photo_sizes import fit_photos, photo_scale
from gsmerge.fit.stage import ON_CPU, FitBackend, fit, fit_scene, peak_weights, run_on, start_share, visible_mask

__all__ = [
    "ON_CPU", "Fit", "FitBackend", "FitOptions", "FitReport", "Fitted", "Tuning", "fit", "fit_photos",
    "fit_scene", "peak_weights", "photo_scale", "record_fit", "report_steps", "run_on", "start_share", "visible_mask",
]  # fmt: skip
