"""Make synthetic scenes from random numbers, as a feed-forward network would export them, for training and tests."""

from gsmerge.research.generate.folders import SceneFolder as SceneFolder
from gsmerge.research.generate.folders import generate as generate
from gsmerge.research.generate.folders import generate_scene as generate_scene
from gsmerge.research.generate.noise import NoiseOptions as NoiseOptions
from gsmerge.research.generate.synthetic_scene import GenerateOptions as GenerateOptions
from gsmerge.research.generate.synthetic_scene import SyntheticScene as SyntheticScene
from gsmerge.research.generate.synthetic_scene import make_synthetic_scene as make_synthetic_scene
