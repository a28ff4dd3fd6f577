"""gaussians -> fitted gaussians: colours alone, or all parameters, against the input photos."""

from gsmerge.fit.color import Drawn, FitReport, draw, fit_colors, seen
from gsmerge.fit.options import FitOptions

__all__ = ["Drawn", "FitOptions", "FitReport", "draw", "fit_colors", "seen"]
