"""Training of the networks on the corrections that the full fit makes, and on renders compared with photos."""

from gsmerge.research.training.examples import Example, make_example, read_examples
from gsmerge.research.training.loop import TrainResult, choose_device, train
from gsmerge.research.training.options import TrainOptions, preset_options, read_config
from gsmerge.research.training.scenes import TrainingScene, make_training_scene

__all__ = [
    "Example",
    "TrainOptions",
    "TrainResult",
    "TrainingScene",
    "choose_device",
    "make_example",
    "make_training_scene",
    "preset_options",
    "read_config",
    "read_examples",
    "train",
]
