"""The engine of the fit and the scores on a GPU: tensors of any device.

Merging stays on the CPU. torch is loaded only where :func:`choose_backend` may take CUDA. On the
torch CPU device the engine gives what the CPU's gives, which is how it is tested;
docs/internals/gpu.md says what differs on a GPU.
"""

from __future__ import annotations

import ctypes
import os
from functools import cache
from importlib.util import find_spec

from gsmerge.fit.cpu import ON_CPU
from gsmerge.fit.engine import FitBackend

# Pixels of all views, as many as an aligned scene has Gaussians, from which "auto" takes CUDA. Starting
# it and importing gsplat takes one to three seconds, in which two processors do a scene of this size from
# end to end.
MIN_PIXELS = 400_000
NO_DEVICE = "torch finds no CUDA device"
NO_TORCH = 'torch is not installed; pip install "torch>=2.4,<3" "gsplat>=1.5,<1.6"'  # as the extra cuda asks for


def choose_backend(device: str, num_pixels: int) -> tuple[FitBackend, str | None]:
    """Choose the device for the fit and the scores; a note says why CUDA cannot be used if it was asked for.

    ``"auto"`` takes CUDA where it can be used and ``num_pixels`` of all views are enough; on a
    computer without torch or a CUDA device it gives no note, and without a CUDA driver torch is not
    loaded.
    """
    if device == "cpu" or (device == "auto" and (num_pixels < MIN_PIXELS or not has_driver())):
        return ON_CPU, None
    problem = cuda_problem()
    if problem is not None:
        note = f"the fit and the scores run on the CPU, not on a GPU: {problem}"
        return ON_CPU, None if device == "auto" and problem in (NO_DEVICE, NO_TORCH) else note
    import torch

    from gsmerge.fit.gpu.engine import make_backend

    return make_backend(torch.device("cuda")), None


@cache
def has_driver() -> bool:
    """Return whether a CUDA driver is installed, without loading torch, which takes half a second."""
    try:
        ctypes.CDLL("nvcuda.dll" if os.name == "nt" else "libcuda.so.1")
    except OSError:
        return False
    return True


@cache
def cuda_problem() -> str | None:
    """Describe in a clause why CUDA devices cannot be used; None if they can.

    The first call of a process loads gsplat and compares what the device computes with the CPU, see
    :mod:`gsmerge.fit.gpu.self_check`.
    """
    if find_spec("torch") is None:
        return NO_TORCH
    import torch

    if not torch.cuda.is_available():
        return NO_DEVICE
    from gsmerge.fit.gpu.self_check import find_difference
    from gsmerge.raster.cuda import gsplat_problem

    return gsplat_problem() or find_difference(torch.device("cuda"))
