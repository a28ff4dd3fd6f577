"""A state with everything that an optimiser step can meet, and gradients for it."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import torch

from gsmerge.fit.fit_options import FitOptions, Tuning
from gsmerge.fit.full import step_sizes
from gsmerge.fit.gpu.adam import FitState, StepGradients, state_of, step_in_torch

RATES = Tuning(
    means_lr=3.0, scales_lr=3.0, opacities_lr=5.0, colors_lr=1.0, max_mean_shift=0.2, max_scale_change=0.1,
    max_opacity_change=0.3,
)  # fmt: skip


def odd_state(count: int, device: torch.device | str = "cpu") -> tuple[FitState, FitOptions]:
    """At its border in most columns, colours beyond the range, a quaternion of length zero, earlier moments."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    x = normal(count, 14)
    x[: count // 8, 11:] += 3
    x[3, 6:10] = 0.0
    x[5, 10], x[6, 10] = 9.0, -9.0
    state = state_of(x, torch.zeros(count, 0, 3))
    state.m, state.v = normal(count, 14) * 0.1, normal(count, 14) ** 2 * 0.1
    state.m[3, 6:10] = 0.0
    state.box_shares = torch.rand(count, generator=generator)
    state.min_sizes = torch.where(torch.rand(count, generator=generator) < 0.5, -torch.inf, normal(count))
    moved = {name: getattr(state, name).to(device) for name in FitState.__dataclass_fields__}
    return FitState(**moved), FitOptions(tuning=replace(RATES, opacity_reg=0.5, scale_reg=0.7))


def gradients_of(state: FitState) -> StepGradients:
    """Random ones; a third of the Gaussians has none."""
    generator, count = torch.Generator().manual_seed(1), len(state)
    reached = torch.rand(count, generator=generator) > 0.3
    reached[3] = False
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 3))
    rows = [torch.randn(*shape, generator=generator) for shape in shapes]
    rows = [row * (reached[:, None] if row.ndim == 2 else reached) for row in rows]
    return StepGradients(*(row.to(state.x.device) for row in rows), reached.to(state.x.device))


def compare_triton() -> None:
    """The Triton kernel against torch, on whatever Triton runs on."""
    from gsmerge.fit.gpu import adam_kernel
    from gsmerge.kernels.gaussians.optimise import MAX_LOGIT, MIN_LOGIT

    limits = adam_kernel.MIN_LOGIT.value, adam_kernel.MAX_LOGIT.value
    torch.testing.assert_close(limits, (float(MIN_LOGIT), float(MAX_LOGIT)))
    state, options = odd_state(300)
    other, gradients = deepcopy(state), gradients_of(state)
    for step in (1, 2, 3):
        rates = torch.from_numpy(step_sizes(options.tuning, 0.3, 8))
        step_in_torch(state, gradients, options, rates, step)
        adam_kernel.launch(other, gradients, options, rates, step)
        for name in ("x", "m", "v", "means", "quats", "scales", "opacities", "colors"):
            torch.testing.assert_close(getattr(other, name), getattr(state, name), rtol=1e-4, atol=1e-5, msg=name)
    print("same")
