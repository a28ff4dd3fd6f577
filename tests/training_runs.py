"""Networks and runs that take a second."""

from __future__ import annotations

from gsmerge.networks import NetworkOptions
from gsmerge.research.training import TrainOptions

TINY = NetworkOptions(width=16, heads=2, latent=8, members=8, neighbors=4)
OPTIONS = TrainOptions(
    network=TINY, densities=(0.1,), fit_steps=12, levels=(1, 2), steps=12, warmup=2, rate=3e-3, crop=60, save_every=4,
    validation_crops=2, photo_start=0.3,
)  # fmt: skip
