"""Rival methods behind one interface: one file each, run by ``compact(scene, method=NAME)``."""

from gsmerge.baselines.baseline import Baseline
from gsmerge.baselines.registry import BASELINES, check_scene, choose_baseline, find_baseline, unused_notes

__all__ = ["BASELINES", "Baseline", "check_scene", "choose_baseline", "find_baseline", "unused_notes"]
