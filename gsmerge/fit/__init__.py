"""gaussians -> fitted gaussians: colours alone, or all parameters, against the input photos."""

from gsmerge.fit.options import Fit, FitOptions, Rates
from gsmerge.fit.report import FitReport
from gsmerge.fit.stage import fit

__all__ = ["Fit", "FitOptions", "FitReport", "Rates", "fit"]
