"""One optimiser step on a device is that of the kernel."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from gpu_runs import gpu
from step_states import gradients_of, odd_state

from gsmerge.fit.full import step_sizes
from gsmerge.fit.gpu.adam import adam_step
from gsmerge.kernels.gaussians import optimise

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize("step", [1, 7])
def test_step_is_the_kernels(step: int) -> None:
    """Everything at its border, colours beyond the range, a quaternion of length zero, Gaussians without a gradient."""
    state, options = odd_state(300)
    gradients = gradients_of(state)
    arrays = [
        getattr(state, name).clone().numpy() for name in ("x", "x0", "m", "v", "units", "box_shares", "min_sizes")
    ]
    ids = np.flatnonzero(gradients.reached.numpy()).astype(np.int32)
    g = [getattr(gradients, name).numpy()[ids] for name in ("means", "quats", "scales", "opacities", "colors")]
    regs = np.array([options.tuning.opacity_reg, options.tuning.scale_reg], np.float32) / np.float32(300)
    rates = step_sizes(options.tuning, 0.3, 8)
    limits = options.tuning.max_mean_shift, options.tuning.max_scale_change, options.tuning.max_opacity_change
    names = ("means", "quats", "scales", "opacities", "colors")
    shown = [getattr(state, name).clone().numpy() for name in names]
    optimise.adam(
        *arrays, ids, *g, rates, np.array(limits, np.float32),
        np.array([options.tuning.beta1, options.tuning.beta2], np.float32), regs, step, 0, len(ids), *shown,
    )  # fmt: skip
    adam_step(state, gradients, options, torch.from_numpy(rates), step)
    assert (np.abs(arrays[0] - arrays[1]) > 0.01).any(1)[ids].mean() > 0.9
    for name, expected in zip(("x", "m", "v", *names), [arrays[0], *arrays[2:4], *shown], strict=True):
        np.testing.assert_allclose(getattr(state, name), expected, rtol=2e-4, atol=2e-6, err_msg=name)


@pytest.mark.skipif(find_spec("triton") is None, reason="needs Triton, which CUDA builds of torch bring")
def test_triton_step_is_the_one_in_torch() -> None:
    """In Triton's interpreter, which has to be asked for before Triton is imported."""
    paths = [str(ROOT), *sys.path]
    environment = {**os.environ, "TRITON_INTERPRET": "1", "PYTHONPATH": os.pathsep.join(paths)}
    code = "import step_states; step_states.compare_triton()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    assert "same" in done.stdout


@gpu
def test_step_of_a_gpu_is_that_of_torch() -> None:
    (state, options), (other, _) = odd_state(300), odd_state(300, "cuda")
    for one in (state, other):
        rates = torch.from_numpy(step_sizes(options.tuning, 0.3, 8)).to(one.x.device)
        adam_step(one, gradients_of(one), options, rates, 1)
    torch.testing.assert_close(other.x.cpu(), state.x, rtol=1e-4, atol=1e-5)
