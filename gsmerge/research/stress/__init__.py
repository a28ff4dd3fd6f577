"""Compaction of a scene under bad conditions: with worse views, poses, photos or rows."""

from gsmerge.research.stress.cases import CASES, Case
from gsmerge.research.stress.check import StressOutcome, stress

__all__ = ["CASES", "Case", "StressOutcome", "stress"]
