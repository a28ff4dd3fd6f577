"""Parameters under optimisation on a device, and the optimiser step of the kernel ``optimise.adam``.

On CUDA one Triton kernel does all of a step (:mod:`gsmerge.fit.gpu.adam_kernel`), elsewhere torch. Both
also write what the new parameters mean to the rasterizer, so a step begins with nothing to compute.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from importlib.util import find_spec

import torch
from torch import Tensor

from gsmerge.fit.fit_state import CARRIED, State, state_of
from gsmerge.kernels.gaussians.optimise import COLOR, LOGIT, MAX_LOGIT, MIN_LOGIT, QUAT, SIZE
from gsmerge.raster.autograd import Shape
from gsmerge.settings.fit import FitOptions
from gsmerge.types import as_array


@dataclass(eq=False)
class DeviceState:
    """Optimiser's state on a device, with the values that the rasterizer reads."""

    host: State  # What was brought to the device, with all that steps do not change
    x: Tensor  # [n,14], as the next three, like the columns of the same names of the host's state
    x0: Tensor
    m: Tensor
    v: Tensor
    units: Tensor  # [n]
    box_shares: Tensor  # [n]
    min_sizes: Tensor  # [n]
    shN: Tensor  # [n,k-1,3] higher harmonics
    means: Tensor  # [n,3]
    quats: Tensor  # [n,4]
    scales: Tensor  # [n,3]
    opacities: Tensor  # [n]
    colors: Tensor  # [n,3] base colours

    def __len__(self) -> int:
        return len(self.x)

    @property
    def shape(self) -> Shape:
        """Means, quaternions, scales and opacities."""
        return self.means, self.quats, self.scales, self.opacities


@dataclass(frozen=True, eq=False)
class StepGradients:
    """Gradients of the loss with respect to the rasterizer's inputs; ``reached [n]`` bool: drawn in the view."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    reached: Tensor


def upload_state(state: State, device: torch.device) -> DeviceState:
    """Copy a state to a device."""
    shown = state.splats
    arrays = (
        state.x, state.x0, state.m, state.v, state.units, state.box_shares, state.min_sizes,
        shown.shN, shown.means, shown.quats, shown.scales, shown.opacities, state.colors,
    )  # fmt: skip
    return DeviceState(state, *(torch.tensor(array, dtype=torch.float32, device=device) for array in arrays))


def download_state(state: DeviceState) -> State:
    """Bring a state back to the host."""
    moved = state_of(as_array(state.x), state.host.splats.shN)
    carried = {name: getattr(state.host, name) for name in CARRIED}
    return replace(moved, **carried | {"m": as_array(state.m), "v": as_array(state.v)})


def adam_step(state: DeviceState, gradients: StepGradients, options: FitOptions, rates: Tensor, step: int) -> None:
    """Take an Adam step by a view's gradients, in place; parameters stay within a box about the start.

    Gaussians that the view does not show stay unchanged. The pulls on opacity and size are added to
    the gradients of the image loss here. ``rates [14]``: see
    :func:`gsmerge.fit.schedule.step_sizes`; ``step`` counts from 1.
    """
    if state.x.is_cuda and has_triton():
        from gsmerge.fit.gpu.adam_kernel import launch

        launch(state, gradients, options.tuning, rates, step)
    else:
        step_in_torch(state, gradients, options, rates, step)


@cache
def has_triton() -> bool:
    """Return whether Triton is installed; CUDA builds of torch for Linux bring it."""
    return find_spec("triton") is not None


def step_in_torch(state: DeviceState, gradients: StepGradients, options: FitOptions, rates: Tensor, step: int) -> None:
    """Take the step of :func:`adam_step` without Triton."""
    gradient, limits = parameter_gradient(state, gradients, options), options.tuning
    energy = gradient * gradient
    for shared in (slice(0, SIZE), slice(QUAT, LOGIT)):  # one second moment, so that steps turn with the scene
        energy[:, shared] = energy[:, shared].sum(1, keepdim=True) / 3  # degrees of freedom, of a rotation too
    reached = gradients.reached[:, None]
    state.m.copy_(torch.where(reached, state.m.lerp(gradient, 1 - limits.beta1), state.m))
    state.v.copy_(torch.where(reached, state.v.lerp(energy, 1 - limits.beta2), state.v))
    first, second = state.m / (1 - limits.beta1**step), state.v / (1 - limits.beta2**step)
    move = rates * first / (second.sqrt() + 1e-15)
    move[:, :SIZE] *= state.units[:, None]
    state.x.copy_(torch.where(reached, confine(state, state.x - move, options), state.x))
    for shown, meaning in (
        (state.means, state.x[:, :SIZE]), (state.quats, state.x[:, QUAT:LOGIT]),
        (state.scales, state.x[:, SIZE:QUAT].exp()), (state.opacities, state.x[:, LOGIT].sigmoid()),
        (state.colors, state.x[:, COLOR:]),
    ):  # fmt: skip
        shown.copy_(meaning)


def parameter_gradient(state: DeviceState, gradients: StepGradients, options: FitOptions) -> Tensor:
    """Return the gradient ``[n,14]`` in optimiser parameters: means in units of size, log scales, logit opacities."""
    units, each = state.units[:, None], gradients.reached[:, None] / max(len(state), 1)
    slope = (state.opacities * (1 - state.opacities))[:, None]
    fade = gradients.opacities[:, None] + options.tuning.opacity_reg * each
    shrink = gradients.scales + options.tuning.scale_reg * each / units
    return torch.cat(
        (gradients.means * units, shrink * state.scales, gradients.quats, fade * slope, gradients.colors), 1
    )


def confine(state: DeviceState, x: Tensor, options: FitOptions) -> Tensor:
    """Clip new parameters ``[n,14]`` to the box about the start, and normalise quaternions."""
    x0, rates, shares = state.x0, options.tuning, state.box_shares[:, None]
    offset = x[:, :SIZE] - x0[:, :SIZE]
    far, reach = offset.norm(dim=1, keepdim=True), shares * rates.max_mean_shift * state.units[:, None]
    x[:, :SIZE] = torch.where(far > reach, x0[:, :SIZE] + reach / far * offset, x[:, :SIZE])
    sizes, logits, colors = x0[:, SIZE:QUAT], x0[:, LOGIT], x0[:, COLOR:]
    grown = shares * rates.max_scale_change
    x[:, SIZE:QUAT] = x[:, SIZE:QUAT].clamp(sizes - grown, sizes + grown).maximum(state.min_sizes[:, None])
    logit = x[:, LOGIT].clamp(logits - rates.max_opacity_change, logits + rates.max_opacity_change)
    x[:, LOGIT] = logit.clamp(float(MIN_LOGIT), float(MAX_LOGIT))
    x[:, COLOR:] = x[:, COLOR:].clamp(colors.clamp_max(-0.05), colors.clamp_min(1.05))
    norm = x[:, QUAT:LOGIT].norm(dim=1, keepdim=True)
    x[:, QUAT:LOGIT] = torch.where(norm > 0, x[:, QUAT:LOGIT] / norm, 0)
    return x
