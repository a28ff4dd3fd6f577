"""Examples in random order, of which few are in memory, read ahead by threads.

Every crop of a step has a stream of its own: every ``crops``-th of the shards, in an order that is shuffled anew for
each pass over them. A stream holds ``buffer`` examples, from which the crop draws one at random; every ``refresh``
steps the next in the order takes the place of the oldest. Which examples these are depends on seed and step alone. So a
run that is resumed goes on as if it had not stopped, and so does one that is shared among processes, each of which
reads the streams of its own crops.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache

import numpy as np

from gsmerge.research.training.examples import Example
from gsmerge.research.training.shards import Shard, read_shard
from gsmerge.research.training.train_options import TrainOptions

ORDER = 2**32 + 1  # takes the place of the step in the seed of the order's random numbers


class ExampleStreams:
    """Streams of examples, one for each of some of a step's crops."""

    def __init__(self, shards: Sequence[Shard], options: TrainOptions, crops: Sequence[int]) -> None:
        self.shards, self.options, self.crops = shards, options, crops
        self.pool = ThreadPoolExecutor(options.workers, thread_name_prefix="gsmerge-read")
        self.examples: dict[int, Future[Example]] = {}  # by number of the shard: those in memory, or being read
        self.checked: set[int] = set()

    def move_to(self, step: int) -> None:
        """Read what the step may draw, and what comes next; forget everything else."""
        ahead = self.options.buffer + 1
        ids = [self.shard_id(step, crop, slot) for slot in range(ahead) for crop in self.crops]
        for number in self.examples.keys() - set(ids):
            self.examples.pop(number).cancel()
        for number in ids:
            if number not in self.examples:
                self.examples[number] = self.pool.submit(self._read, number)

    def draw(self, step: int, crop: int, rng: np.random.Generator) -> Example:
        """Draw one of the examples of a crop of the step that was moved to."""
        slot = int(rng.integers(self.options.buffer))
        return self.examples[self.shard_id(step, crop, slot)].result()

    def shard_id(self, step: int, crop: int, slot: int) -> int:
        """Return the number of the shard that a crop's stream has in a slot: 0 is the oldest."""
        position = (step // self.options.refresh + slot) * self.options.crops + crop
        epoch, rest = divmod(position, len(self.shards))
        return int(_order(self.options.seed, epoch, len(self.shards))[rest])

    def _read(self, number: int) -> Example:
        example = read_shard(self.shards[number], check=number not in self.checked)
        self.checked.add(number)
        return example


@contextmanager
def open_streams(shards: Sequence[Shard], options: TrainOptions, crops: Sequence[int]) -> Iterator[ExampleStreams]:
    """Open streams whose threads end with the block."""
    streams = ExampleStreams(shards, options, crops)
    try:
        yield streams
    finally:
        streams.pool.shutdown(cancel_futures=True)


@lru_cache(maxsize=4)
def _order(seed: int, epoch: int, count: int) -> np.ndarray:
    """Shuffle all shards for one pass over them, ``[count]``."""
    return np.random.default_rng([seed, ORDER, epoch]).permutation(count)
