"""Synthetic scenes from random numbers alone, as a feed-forward network would export them, for training and tests."""

from gsmerge.research.generate.folders import SceneFolder, generate, generate_scene
from gsmerge.research.generate.noise import NoiseOptions
from gsmerge.research.generate.synthetic_scene import GenerateOptions, SyntheticScene, make_scene

__all__ = [
    "GenerateOptions",
    "NoiseOptions",
    "SceneFolder",
    "SyntheticScene",
    "generate",
    "generate_scene",
    "make_scene",
]
