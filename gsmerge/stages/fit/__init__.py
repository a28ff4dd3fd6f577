"""gaussians -> fitted gaussians: colours alone, or all parameters, against the input photos."""

from gsmerge.stages.fit.options import Fit, FitOptions, Rates
from gsmerge.stages.fit.report import FitReport
from gsmerge.stages.fit.stage import fit, fit_scene, shown, start_share

__all__ = ["Fit", "FitOptions", "FitReport", "Rates", "fit", "fit_scene", "shown", "start_share"]
