"""What tests of several files here need: options of runs that repeat to the last digits, and how to compare them."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest
import scenes
import torch

from gsmerge import Gaussians
from gsmerge.fit import FitOptions
from gsmerge.fit.fit_options import Tuning
from gsmerge.fit.gpu.backend import make_backend
from gsmerge.fit.gpu.device_photos import DevicePhotos, upload_photos
from gsmerge.raster.photos import Photos

Pair = tuple[Photos, Photos]
CPU = torch.device("cpu")
ON_TORCH = make_backend(CPU)  # torch on the CPU
gpu = pytest.mark.skipif(
    not torch.cuda.is_available() or find_spec("gsplat") is None, reason="needs a CUDA device and gsplat"
)
# A long memory: with a short one a difference in the last bit is a full step sooner.
PULLS = FitOptions(fit_steps=8, holdout=0.2, tuning=Tuning(beta1=0.7, beta2=0.99))
# Without the pulls: where they are the whole gradient, Adam turns its last bit into a full step.
QUICK = scenes.tuned(PULLS, opacity_reg=0.0, scale_reg=0.0)


def on_device(photos: Pair, device: torch.device = CPU) -> tuple[DevicePhotos, DevicePhotos]:
    return upload_photos(photos[0], device), upload_photos(photos[1], device)


def assert_close(actual: Gaussians, expected: Gaussians, atol: float) -> None:
    """All but one number in a hundred: Adam makes a step of a gradient's sign, of whatever size that gradient is."""
    assert len(actual) == len(expected)
    for name in scenes.FIELDS:
        a, b = (getattr(gaussians, name) for gaussians in (actual, expected))
        assert (np.abs(a - b) > atol + 1e-3 * np.abs(b)).sum() <= 0.01 * a.size, name
        np.testing.assert_allclose(a, b, atol=10 * atol, rtol=1e-2, err_msg=name)
