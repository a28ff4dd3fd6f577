"""Training of the networks on what the fit itself finds out about scenes, and on renders against photos."""

from gsmerge.research.training.examples import Example, make_example, read_examples
from gsmerge.research.training.loop import Trained, network_device, train
from gsmerge.research.training.options import TrainOptions, read_config
from gsmerge.research.training.presets import preset_options
from gsmerge.research.training.subjects import Subject, make_subject

__all__ = [
    "Example",
    "Subject",
    "TrainOptions",
    "Trained",
    "make_example",
    "make_subject",
    "network_device",
    "preset_options",
    "read_config",
    "read_examples",
    "train",
]
