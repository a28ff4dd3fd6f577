"""Train the networks by comparing renders with photos."""

from gsmerge.research.training.backbones import Backbone as Backbone
from gsmerge.research.training.backbones import Capture as Capture
from gsmerge.research.training.examples import Example as Example
from gsmerge.research.training.examples import make_example as make_example
from gsmerge.research.training.loop import train as train
from gsmerge.research.training.scenes import make_training_scene as make_training_scene
from gsmerge.research.training.shards import Shard as Shard
from gsmerge.research.training.shards import prepare_shards as prepare_shards
from gsmerge.research.training.shards import read_shard as read_shard
from gsmerge.research.training.shards import write_shard as write_shard
from gsmerge.research.training.train_options import TrainOptions as TrainOptions
from gsmerge.research.training.train_options import preset_options as preset_options
