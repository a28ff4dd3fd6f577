"""Training of the networks on renders compared with photos."""

from gsmerge.research.training.examples import Example, make_example
from gsmerge.research.training.loop import choose_device, train
from gsmerge.research.training.scenes import make_training_scene
from gsmerge.research.training.shards import Shard, prepare_shards, read_shard, write_shard
from gsmerge.research.training.train_options import TrainOptions, preset_options

__all__ = [
    "Example",
    "Shard",
    "TrainOptions",
    "choose_device",
    "make_example",
    "make_training_scene",
    "prepare_shards",
    "preset_options",
    "read_shard",
    "train",
    "write_shard",
]
