"""gaussians -> fitted gaussians: colours alone, or all parameters, against the input photos."""

from gsmerge.stages.fit.options import Fit, FitOptions, LearningRates
from gsmerge.stages.fit.photos import fit_photos, photo_scale
from gsmerge.stages.fit.report import FitReport, Fitted, record_fit, report_steps
from gsmerge.stages.fit.stage import fit, fit_scene, start_share, visible_mask

__all__ = [
    "Fit", "FitOptions", "FitReport", "Fitted", "LearningRates", "fit", "fit_photos", "fit_scene", "photo_scale",
    "record_fit", "report_steps", "start_share", "visible_mask",
]  # fmt: skip
