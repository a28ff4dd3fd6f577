"""Networks, examples and runs take a second; tests that import this are skipped where torch is missing."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import pytest
from network_fixtures import LAST

pytest.importorskip("torch", reason="torch is not installed")

import numpy as np
import torch

from gsmerge.method.networks.options import NetworkOptions
from gsmerge.method.networks.weights import NetworkWeights
from gsmerge.research.training import Example, Shard, TrainOptions, write_shard
from gsmerge.research.training.modules import Networks
from gsmerge.research.training.windows import Box, Crop, Window

TINY = NetworkOptions(width=16, heads=2, latent=8, members=8, neighbors=4)
OPTIONS = TrainOptions(
    network=TINY, densities=(0.1,), levels=(1, 2), steps=12, warmup=2, rate=3e-3, save_every=4, window=16,
    validation_windows=1,
)  # fmt: skip
# As the paper's, in small: absolute heads, random views, boxes.
PAPER = replace(
    OPTIONS,
    network=replace(TINY, outputs="absolute", geometry="carried", group_numbers=False, merger_start="first"),
    random_views=(1, 12), match="aabb", joint=True, photo_loss="mse", photo_weight=1.0,
    ssim_weight=0.05, teacher_weight=0.25, diversity_weight=1.0,
)  # fmt: skip


def modules_of(weights: NetworkWeights) -> Networks:
    """Return networks that can be trained, with these weights."""
    modules = Networks(weights.options)
    modules.load_state_dict({name: torch.from_numpy(array) for name, array in weights.arrays.items()})
    return modules


def noisy_networks(options: NetworkOptions, scale: float = 0.3, seed: int = 0) -> Networks:
    """Return networks as they are before training, with random last layers; they collect no gradients yet."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        networks = Networks(options)
        for name, parameter in networks.named_parameters():
            if name.split(".")[-2] in LAST and not bool(parameter.any()):
                torch.nn.init.normal_(parameter, std=scale)
    return networks.eval().requires_grad_(False)


def whole_photo(example: Example, photo: int, k: int = 1) -> Window:
    """Return a window of a whole photo, with all Feature Gaussians."""
    height, width = example.images.shape[1:3]
    return Window(photo, Box(0, 0, width, height), Crop(example, k, np.arange(len(example.features))))


def written(example: Example, folder: Path) -> Shard:
    """Write the example as a shard, in a file that is named after it."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{hashlib.sha256(example.images.tobytes()).hexdigest()[:8]}-{len(example.features)}.safetensors"
    return Shard(path, example.name, write_shard(path, example))
