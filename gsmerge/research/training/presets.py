"""Settings of training runs under a name."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from gsmerge.research.training.options import TrainOptions

# Table of hyperparameters and section 5.1 of the paper. What it does not say is as in the default.
PAPER: Mapping[str, Any] = MappingProxyType(
    {
        "network": {"outputs": "absolute"},
        "views": tuple(range(1, 13)),
        "match": "aabb",
        "levels": (1, 2, 4),
        "steps": 300_000,
        "warmup": 2_000,
        "rate": 5e-5,
        "least_rate": 1e-6,
        "clip": 10.0,
        "photo_start": 0.0,
        "photo_loss": "mse",
        "photo_weight": 1.0,
        "ssim_weight": 0.05,
        "lpips_weight": 0.05,
        "regression_weight": 0.0,
        "teacher_weight": 0.25,
        "teacher_steps": 2_000,
        "diversity_weight": 1.0,
        "diversity_steps": 50_000,
    }
)
PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType({"default": MappingProxyType({}), "paper": PAPER})


def preset_options(name: str) -> TrainOptions:
    """The settings under a name.

    Raises:
        ValueError: If there are none.
    """
    if name not in PRESETS:
        raise ValueError(f"preset: expected {' or '.join(PRESETS)}, got {name!r}")
    return TrainOptions.from_dict(PRESETS[name])
