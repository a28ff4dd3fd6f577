"""Scenes made from random numbers alone, as a feed-forward network would export them: to train on and to test with."""

from gsmerge.research.generate.options import GenerateOptions, NoiseOptions, read_ranges
from gsmerge.research.generate.run import Generated, generate, generate_scene, plan
from gsmerge.research.generate.scene import MadeScene, make_scene

__all__ = [
    "GenerateOptions",
    "Generated",
    "MadeScene",
    "NoiseOptions",
    "generate",
    "generate_scene",
    "make_scene",
    "plan",
    "read_ranges",
]
