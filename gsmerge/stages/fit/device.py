"""The full fit's step in torch, for a GPU.

The run is :func:`gsmerge.stages.fit.full.fit_full` itself: order of the views, rates, growth and the judging of the
held-out blocks stay there and on the CPU, whose renderer the result is for. What happens in every step is here: the
image, its loss, Adam and the box, all on tensors. They are what :func:`gsmerge.stages.fit.full.fit_step` computes,
drawn from the same random numbers, so on the CPU both give the same states.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsmerge.kernels.gaussians.optimise import COLOR, LOGIT, MAX_LOGIT, MIN_LOGIT, QUAT, SIZE
from gsmerge.render.colored import draw_colored, seen_colors
from gsmerge.stages.fit.full import Engine, Plan, step_sizes
from gsmerge.stages.fit.loss import loss_ssim
from gsmerge.stages.fit.options import FitOptions, LearningRates
from gsmerge.stages.fit.state import State, state_of
from gsmerge.types import SH_C0


@dataclass(eq=False)
class DeviceState:
    """A state's arrays as tensors, which run ahead of it until they are settled.

    Args:
        state: The state that they came from.
        x: ``[n,14]`` parameters, see :class:`gsmerge.stages.fit.state.State`, as are the following.
        x0: Where each began.
        box_shares: ``[n,1]`` share of the box.
        m: First moment.
        v: Second moment.
        units: ``[n,1]`` size of each Gaussian.
        shN: ``[n,k-1,3]`` higher harmonics.
    """

    state: State
    x: Tensor
    x0: Tensor
    box_shares: Tensor
    m: Tensor
    v: Tensor
    units: Tensor
    shN: Tensor


def gpu_engine(device: str) -> Engine:
    """What a run steps with on a GPU, which is ready for it."""
    start_gpu(torch.device(device))
    return torch_engine(torch.device(device))


def start_gpu(device: torch.device) -> None:
    """Draw one Gaussian, so that loading and compiling are not taken for the time of the first steps."""
    one = [torch.ones(1, *size, device=device, requires_grad=True) for size in ((3,), (4,), (3,), (), (3,))]
    K = np.array([[8.0, 0, 4], [0, 8.0, 4], [0, 0, 1]])
    camera = {"viewmat": np.eye(4), "K": K, "width": 8, "height": 8, "eps2d": 0.3}
    with torch.enable_grad():
        image, _ = draw_colored((one[0], one[1], one[2], one[3]), one[4], camera, np.zeros(3, np.float32))
        image.sum().backward()


def torch_engine(device: torch.device) -> Engine:
    """Steps in torch on a device, for one run."""
    tensors: list[DeviceState] = []

    def step_view(state: State, plan: Plan, view: int, step: int, progress: float, rng: np.random.Generator) -> float:
        if not tensors or tensors[0].state is not state:  # the first step, or the first after growth
            tensors[:] = [upload(state, device)]
        return torch_step(tensors[0], plan, view, step, progress, rng)

    def sync(state: State) -> None:
        if tensors and tensors[0].state is state:
            download(tensors[0])

    return Engine(step_view, sync)


def upload(state: State, device: torch.device) -> DeviceState:
    """The arrays of a state on a device."""

    def tensor(array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(device, copy=True)

    arrays = (state.x, state.x0, state.box_shares[:, None], state.m, state.v, state.units[:, None], state.splats.shN)
    return DeviceState(state, *(tensor(array) for array in arrays))


def download(tensors: DeviceState) -> None:
    """Bring the state's arrays up to date with the tensors."""
    state = tensors.state
    for name in ("x", "m", "v"):
        getattr(state, name)[...] = getattr(tensors, name).cpu().numpy()
    fresh = state_of(state.x, state.splats.shN)
    for name in ("means", "quats", "scales", "opacities"):
        getattr(state.splats, name)[...] = getattr(fresh.splats, name)
    state.colors[...] = fresh.colors


def torch_step(
    tensors: DeviceState, plan: Plan, view: int, step: int, progress: float, rng: np.random.Generator
) -> float:
    """:func:`gsmerge.stages.fit.full.fit_step` on tensors -> mean squared error of the view's training pixels."""
    level = 1 if progress < plan.options.half_res_part else 0
    photos = plan.photos[level]
    photo = torch.from_numpy(photos.images[view]).to(tensors.x)
    weight = torch.from_numpy(plan.step_weights[level][view]).to(tensors.x)
    background = rng.random(3, dtype=np.float32)
    means, quats, scales, opacities = shape_of(tensors.x)
    drawn = opacities
    if plan.dropout > 0:
        kept = torch.from_numpy(rng.random(len(tensors.x), dtype=np.float32) >= plan.dropout).to(tensors.x.device)
        drawn = kept * (opacities / (1 - plan.dropout)).clamp_max(0.99)
    camera = photos.camera(view)
    with torch.enable_grad():
        leaves = [
            tensor.detach().contiguous().requires_grad_()
            for tensor in (means, quats, scales, drawn, view_colors(tensors, means, camera["viewmat"]))
        ]
        image, reached = draw_colored((leaves[0], leaves[1], leaves[2], leaves[3]), leaves[4], camera, background)
        loss = image_loss(image, photo, weight, plan.options.ssim_lambda)
        gradients = torch.autograd.grad(loss, leaves)
    with torch.no_grad():
        slope, each = (opacities * (1 - opacities))[:, None], reached[:, None] / max(len(tensors.x), 1)
        fade = gradients[3][:, None] + plan.options.opacity_reg * each
        shrink = gradients[2] + plan.options.scale_reg * each / tensors.units
        rows = (gradients[0] * tensors.units, shrink * scales, gradients[1], fade * slope, gradients[4])
        adam_step(tensors, torch.cat(rows, 1), plan.options, progress, step)
        return mean_error(image, photo, weight)


def shape_of(x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Means, quaternions, scales and opacities that parameters ``[n,14]`` mean to the rasterizer."""
    return x[:, :SIZE], x[:, QUAT:LOGIT], x[:, SIZE:QUAT].exp(), x[:, LOGIT].sigmoid()


def view_colors(tensors: DeviceState, means: Tensor, viewmat: np.ndarray) -> Tensor:
    """``[n,3]`` colours in a view: as they are, or through the harmonics."""
    colors = tensors.x[:, COLOR:]
    if tensors.shN.shape[1] == 0:
        return colors
    return seen_colors(means, ((colors - 0.5) / SH_C0)[:, None], tensors.shN, viewmat)


def image_loss(image: Tensor, photo: Tensor, weight: Tensor, ssim_lambda: float) -> Tensor:
    """The loss whose gradient :func:`gsmerge.stages.fit.loss.image_gradient` is: L1 and structural similarity.

    Args:
        image: ``[h,w,3]``.
        photo: ``[h,w,3]``.
        weight: ``[h,w]`` weights of the pixels.
        ssim_lambda: Share of structural similarity, see :func:`gsmerge.stages.fit.loss.loss_ssim`.
    """
    each = (1 - ssim_lambda) * (image - photo).abs() + ssim_lambda * (1 - loss_ssim(image, photo))
    return (weight[..., None] * each).sum() / weight.numel()


def mean_error(image: Tensor, photo: Tensor, weight: Tensor) -> float:
    """Mean squared error of the weighted pixels."""
    error = (weight[..., None] * (image - photo) ** 2).sum(dtype=torch.float64)
    return float(error / (3 * weight.sum(dtype=torch.float64)).clamp_min(1))


def adam_step(tensors: DeviceState, gradient: Tensor, options: FitOptions, progress: float, step: int) -> None:
    """Adam on a gradient ``[n,14]``, then the box: :func:`gsmerge.kernels.gaussians.optimise.adam` on tensors."""
    rates, energy = options.rates, gradient * gradient
    for shared in (slice(0, SIZE), slice(QUAT, LOGIT)):  # one second moment, so that steps turn with the scene
        energy[:, shared] = energy[:, shared].sum(1, keepdim=True) / 3  # degrees of freedom, of a rotation too
    tensors.m.lerp_(gradient, 1 - rates.beta1)
    tensors.v.lerp_(energy, 1 - rates.beta2)
    first, second = tensors.m / (1 - rates.beta1**step), tensors.v / (1 - rates.beta2**step)
    move = torch.from_numpy(step_sizes(rates, progress, options.steps)).to(tensors.x) * first / (second.sqrt() + 1e-15)
    move[:, :SIZE] *= tensors.units
    confine(tensors, tensors.x - move, rates)


def confine(tensors: DeviceState, x: Tensor, rates: LearningRates) -> None:
    """New parameters, brought into the box about the start."""
    x0 = tensors.x0
    offset = x[:, :SIZE] - x0[:, :SIZE]
    far, reach = offset.norm(dim=1, keepdim=True), tensors.box_shares * rates.max_mean_shift * tensors.units
    x[:, :SIZE] = torch.where(far > reach, x0[:, :SIZE] + reach / far * offset, x[:, :SIZE])
    sizes, logits, colors = x0[:, SIZE:QUAT], x0[:, LOGIT], x0[:, COLOR:]
    grown = tensors.box_shares * rates.max_scale_change
    x[:, SIZE:QUAT] = x[:, SIZE:QUAT].clamp(sizes - grown, sizes + grown)
    logit = x[:, LOGIT].clamp(logits - rates.max_opacity_change, logits + rates.max_opacity_change)
    x[:, LOGIT] = logit.clamp(float(MIN_LOGIT), float(MAX_LOGIT))
    x[:, COLOR:] = x[:, COLOR:].clamp(colors.clamp_max(-0.05), colors.clamp_min(1.05))
    norm = x[:, QUAT:LOGIT].norm(dim=1, keepdim=True)
    x[:, QUAT:LOGIT] = torch.where(norm > 0, x[:, QUAT:LOGIT] / norm, 0)
    tensors.x = x
