"""A scene under bad conditions: what a user's own scene would do if its views, poses, photos or rows were worse."""

from gsmerge.research.stress.cases import CASES, Case
from gsmerge.research.stress.run import StressOutcome, stress

__all__ = ["CASES", "Case", "StressOutcome", "stress"]
