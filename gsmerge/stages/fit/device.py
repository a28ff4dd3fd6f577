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
from gsmerge.stages.fit.full import KERNELS, Engine, Plan, step_sizes
from gsmerge.stages.fit.loss import loss_ssim
from gsmerge.stages.fit.options import FitOptions, Rates
from gsmerge.stages.fit.state import State, state_of
from gsmerge.types import SH_C0


@dataclass(eq=False)
class Held:
    """A state's arrays as tensors, which run ahead of it until they are settled.

    Args:
        state: The state that they came from.
        x: ``[n,14]`` parameters, see :class:`gsmerge.stages.fit.state.State`, as are the following.
        x0: Where each began.
        shares: ``[n,1]`` share of the box.
        m: First moment.
        v: Second moment.
        units: ``[n,1]`` size of each Gaussian.
        shN: ``[n,k-1,3]`` higher harmonics.
    """

    state: State
    x: Tensor
    x0: Tensor
    shares: Tensor
    m: Tensor
    v: Tensor
    units: Tensor
    shN: Tensor


def engine_for(device: str) -> Engine:
    """What a run steps with on ``"cpu"`` or ``"cuda"``."""
    if device == "cpu":
        return KERNELS
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
    held: list[Held] = []

    def step_view(state: State, plan: Plan, view: int, step: int, progress: float, rng: np.random.Generator) -> float:
        if not held or held[0].state is not state:  # the first step, or the first after growth
            held[:] = [upload(state, device)]
        return torch_step(held[0], plan, view, step, progress, rng)

    def settle(state: State) -> None:
        if held and held[0].state is state:
            download(held[0])

    return Engine(step_view, settle)


def upload(state: State, device: torch.device) -> Held:
    """The arrays of a state on a device."""

    def tensor(array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(device, copy=True)

    arrays = (state.x, state.x0, state.shares[:, None], state.m, state.v, state.units[:, None], state.splats.shN)
    return Held(state, *(tensor(array) for array in arrays))


def download(held: Held) -> None:
    """Bring the state's arrays up to date with the tensors."""
    state = held.state
    for name in ("x", "m", "v"):
        getattr(state, name)[...] = getattr(held, name).cpu().numpy()
    fresh = state_of(state.x, state.splats.shN)
    for name in ("means", "quats", "scales", "opacities"):
        getattr(state.splats, name)[...] = getattr(fresh.splats, name)
    state.colors[...] = fresh.colors


def torch_step(held: Held, plan: Plan, view: int, step: int, progress: float, rng: np.random.Generator) -> float:
    """:func:`gsmerge.stages.fit.full.fit_step` on tensors -> mean squared error of the view's training pixels."""
    level = 1 if progress < plan.options.coarse_share else 0
    photos = plan.photos[level]
    photo = torch.from_numpy(photos.images[view]).to(held.x)
    weight = torch.from_numpy(plan.step_weights[level][view]).to(held.x)
    background = rng.random(3, dtype=np.float32)
    means, quats, scales, opacities = shape_of(held.x)
    drawn = opacities
    if plan.dropout > 0:
        kept = torch.from_numpy(rng.random(len(held.x), dtype=np.float32) >= plan.dropout).to(held.x.device)
        drawn = kept * (opacities / (1 - plan.dropout)).clamp_max(0.99)
    camera = photos.camera(view)
    with torch.enable_grad():
        leaves = [
            tensor.detach().contiguous().requires_grad_()
            for tensor in (means, quats, scales, drawn, view_colors(held, means, camera["viewmat"]))
        ]
        image, reached = draw_colored((leaves[0], leaves[1], leaves[2], leaves[3]), leaves[4], camera, background)
        loss = image_loss(image, photo, weight, plan.options.dssim)
        wanted = torch.autograd.grad(loss, leaves)
    with torch.no_grad():
        slope, each = (opacities * (1 - opacities))[:, None], reached[:, None] / max(len(held.x), 1)
        fade = wanted[3][:, None] + plan.options.opacity_pull * each
        shrink = wanted[2] + plan.options.size_pull * each / held.units
        rows = (wanted[0] * held.units, shrink * scales, wanted[1], fade * slope, wanted[4])
        adam_step(held, torch.cat(rows, 1), plan.options, progress, step)
        return mean_error(image, photo, weight)


def shape_of(x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Means, quaternions, scales and opacities that parameters ``[n,14]`` mean to the rasterizer."""
    return x[:, :SIZE], x[:, QUAT:LOGIT], x[:, SIZE:QUAT].exp(), x[:, LOGIT].sigmoid()


def view_colors(held: Held, means: Tensor, viewmat: np.ndarray) -> Tensor:
    """``[n,3]`` colours in a view: as they are, or through the harmonics."""
    colors = held.x[:, COLOR:]
    if held.shN.shape[1] == 0:
        return colors
    return seen_colors(means, ((colors - 0.5) / SH_C0)[:, None], held.shN, viewmat)


def image_loss(image: Tensor, photo: Tensor, weight: Tensor, dssim: float) -> Tensor:
    """The loss whose gradient :func:`gsmerge.stages.fit.loss.image_gradient` is: L1 and structural similarity.

    Args:
        image: ``[h,w,3]``.
        photo: ``[h,w,3]``.
        weight: ``[h,w]`` weights of the pixels.
        dssim: Share of structural similarity, see :func:`gsmerge.stages.fit.loss.loss_ssim`.
    """
    each = (1 - dssim) * (image - photo).abs() + dssim * (1 - loss_ssim(image, photo))
    return (weight[..., None] * each).sum() / weight.numel()


def mean_error(image: Tensor, photo: Tensor, weight: Tensor) -> float:
    """Mean squared error of the weighted pixels."""
    error = (weight[..., None] * (image - photo) ** 2).sum(dtype=torch.float64)
    return float(error / (3 * weight.sum(dtype=torch.float64)).clamp_min(1))


def adam_step(held: Held, gradient: Tensor, options: FitOptions, progress: float, step: int) -> None:
    """Adam on a gradient ``[n,14]``, then the box: :func:`gsmerge.kernels.gaussians.optimise.adam` on tensors."""
    rates, energy = options.rates, gradient * gradient
    for shared in (slice(0, SIZE), slice(QUAT, LOGIT)):  # one second moment, so that steps turn with the scene
        energy[:, shared] = energy[:, shared].sum(1, keepdim=True) / 3  # degrees of freedom, of a rotation too
    held.m.lerp_(gradient, 1 - rates.beta1)
    held.v.lerp_(energy, 1 - rates.beta2)
    first, second = held.m / (1 - rates.beta1**step), held.v / (1 - rates.beta2**step)
    move = torch.from_numpy(step_sizes(rates, progress, options.steps)).to(held.x) * first / (second.sqrt() + 1e-15)
    move[:, :SIZE] *= held.units
    confine(held, held.x - move, rates)


def confine(held: Held, x: Tensor, rates: Rates) -> None:
    """New parameters, brought into the box about the start."""
    x0 = held.x0
    offset = x[:, :SIZE] - x0[:, :SIZE]
    far, reach = offset.norm(dim=1, keepdim=True), held.shares * rates.reach_mean * held.units
    x[:, :SIZE] = torch.where(far > reach, x0[:, :SIZE] + reach / far * offset, x[:, :SIZE])
    sizes, logits, colors = x0[:, SIZE:QUAT], x0[:, LOGIT], x0[:, COLOR:]
    grown = held.shares * rates.reach_size
    x[:, SIZE:QUAT] = x[:, SIZE:QUAT].clamp(sizes - grown, sizes + grown)
    logit = x[:, LOGIT].clamp(logits - rates.reach_logit, logits + rates.reach_logit)
    x[:, LOGIT] = logit.clamp(float(MIN_LOGIT), float(MAX_LOGIT))
    x[:, COLOR:] = x[:, COLOR:].clamp(colors.clamp_max(-0.05), colors.clamp_min(1.05))
    norm = x[:, QUAT:LOGIT].norm(dim=1, keepdim=True)
    x[:, QUAT:LOGIT] = torch.where(norm > 0, x[:, QUAT:LOGIT] / norm, 0)
    held.x = x
