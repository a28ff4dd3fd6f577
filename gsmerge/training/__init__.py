"""Training of the networks on what the fit itself finds out about scenes."""

from gsmerge.training.examples import Example, make_example, read_examples
from gsmerge.training.loop import Trained, train
from gsmerge.training.options import TrainOptions, read_config

__all__ = ["Example", "TrainOptions", "Trained", "make_example", "read_config", "read_examples", "train"]
