"""The engine of the fit on a device: gsplat draws and differentiates, everything else is torch or Triton.

On torch's CPU device the project's kernels draw. What comes back from the device during a run are scores
at its beginning and at the change of sizes, Gaussians that are halved, and the error once in ``READ_EVERY``
steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import torch
from torch import Tensor

from gsmerge.fit.color import fit_offsets
from gsmerge.fit.engine import Engine, FitBackend
from gsmerge.fit.fit_state import State, start_state
from gsmerge.fit.gpu.adam import DeviceState, StepGradients, adam_step, download_state, upload_state
from gsmerge.fit.gpu.color_system import color_system
from gsmerge.fit.gpu.device_photos import (
    DevicePhotos,
    draw_and_transpose,
    draw_black,
    draw_gaussians,
    draw_view,
    harmonic_colors,
    to_device,
    upload_gaussians,
    upload_photos,
    view_peaks,
)
from gsmerge.fit.gpu.image_scores import loss_gradient, photo_means, score_blocks
from gsmerge.fit.outside import TOUCHED
from gsmerge.fit.report import FitResult
from gsmerge.fit.schedule import FitPlan, Step, loss_weights, step_sizes
from gsmerge.fit.survey import Survey
from gsmerge.kernels.raster.blend import MAX_ALPHA
from gsmerge.raster import render
from gsmerge.raster.photos import COVERED, Photos, PhotoScore, mean_score, score_view
from gsmerge.types import SH_C0, Cameras, Gaussians, as_array

READ_EVERY = 20  # steps; each reading waits for the device


@dataclass(frozen=True, eq=False)
class _GpuEngine:
    """Engine of tensors, see :class:`gsmerge.fit.engine.Engine`."""

    plan: FitPlan
    device: torch.device
    viewmats: np.ndarray | None = None
    read_every: int = READ_EVERY

    @cached_property
    def photos(self) -> tuple[DevicePhotos, ...]:
        """Photos at full and at half size."""
        return tuple(upload_photos(photos, self.device) for photos in self.plan.job.photos)

    @cached_property
    def means(self) -> list[Tensor]:
        """Window means of the photos of each size, for steps, see :func:`gsmerge.fit.gpu.image_scores.photo_means`."""
        return [photo_means(photos.images) for photos in self.photos]

    @cached_property
    def weights(self) -> list[Tensor]:
        """Weights of a step ``[v,h,w]`` at each size; ``[1,h,w]`` where those of all views are the same."""
        return [
            to_device(np.stack(each[: 1 if each[0] is each[-1] else None]), self.device)
            for each in self.plan.step_weights
        ]

    @cached_property
    def outside(self) -> DevicePhotos:
        """Views from outside."""
        assert self.plan.job.outside is not None
        return upload_photos(self.plan.job.outside, self.device)

    def _send(self, array: np.ndarray) -> Tensor:
        """Bring a small array to the device without waiting for it."""
        tensor = torch.from_numpy(array)
        return (tensor.pin_memory() if self.device.type == "cuda" else tensor).to(self.device, non_blocking=True)

    def at_poses(self, viewmats: np.ndarray) -> Engine:
        raise NotImplementedError("the CPU alone moves cameras")

    def survey(self, gaussians: Gaussians) -> Survey:
        state, half = self.start(start_state(gaussians)), self.photos[1]
        images = []
        sums, squares = (torch.zeros(len(state), dtype=torch.float64, device=self.device) for _ in range(2))
        peaks, pixels = torch.zeros_like(state.units), torch.full_like(state.units, torch.inf)
        inside = torch.zeros_like(state.units, dtype=torch.bool)
        for view in range(len(half)):
            image, transpose, reached = draw_and_transpose(state.shape, state_colors(state, half, view), half, view)
            each = transpose(torch.ones_like(image))[:, 0].double()
            images.append(image)
            sums += each
            squares += each * each
            inside |= reached
            peaks = peaks.maximum(view_peaks(state.shape, half, view))
            ahead = half.viewmats[view, 2]
            focal = max(float(photos.Ks[view][[0, 1], [0, 1]].max()) for photos in self.plan.job.photos)
            sizes = (state.means @ ahead[:3] + ahead[3]) / focal
            pixels = torch.where(reached, pixels.minimum(sizes), pixels)
        return Survey(self._score_images(images), *map(as_array, (inside, peaks, sums, squares, pixels)))

    def start(self, state: State) -> DeviceState:
        return upload_state(state, self.device)

    def read(self, state: DeviceState) -> State:
        return download_state(state)

    def warm_up(self, state: DeviceState) -> None:
        """Take a step on a copy: loading kernels is not to be timed."""
        background = np.zeros(3, np.float32)
        error = self.step(deepcopy(state), Step(1, 0.0, self.plan.draw_mode(1, 0.0), 0, background, None))
        float(error)  # waits for the device

    def step(self, state: DeviceState, step: Step) -> Tensor:
        mode, rates = step.mode, self.plan.job.options.tuning
        photos, weights = self.photos[mode.size], self.weights[mode.size]
        means, quats, scales, opacities = state.shape
        if step.kept is not None:
            fuller = (opacities / (1 - self.plan.dropout)).clamp_max(float(MAX_ALPHA))
            opacities = self._send(step.kept) * fuller
        colors = state_colors(state, photos, step.view)
        with torch.enable_grad():
            leaves = [tensor.detach().requires_grad_() for tensor in (means, quats, scales, opacities, colors)]
            image, reached = draw_view(
                (leaves[0], leaves[1], leaves[2], leaves[3]), leaves[4], photos, step.view,
                self._send(step.background), eps2d=mode.eps2d, antialiased=mode.antialiased,
            )  # fmt: skip
        photo, weight = photos.images[step.view], weights[step.view % len(weights)]
        balance = loss_weights(rates, step.progress)
        wanted, error = loss_gradient(image.detach(), photo, self.means[mode.size][step.view], weight, *balance)
        g = torch.autograd.grad(image, leaves, wanted)
        self._move(state, StepGradients(g[0], g[1], g[2], g[3], g[4], reached), step)
        return error / (3 * weight.sum()).clamp_min(1)

    def clear_fog(self, state: DeviceState, step: Step, view: int) -> None:
        assert self.outside.host.weights is not None
        weights, white = self._send(self.outside.host.weights[view]), torch.ones_like(state.colors)
        with torch.enable_grad():
            means, quats, scales, opacities = (tensor.detach().requires_grad_() for tensor in state.shape)
            image = draw_black((means, quats, scales, opacities), white, self.outside, view)  # the opacity, three times
        wanted = (weights / (3 * weights.numel()))[..., None].expand_as(image)
        g = torch.autograd.grad(image, (means, quats, scales, opacities), wanted.contiguous())
        touched = g[3].abs() > TOUCHED
        self._move(state, StepGradients(g[0], g[1], g[2], g[3], torch.zeros_like(white), touched), step)

    def _move(self, state: DeviceState, gradients: StepGradients, step: Step) -> None:
        options = self.plan.job.options
        rates = self._send(step_sizes(options.tuning, step.progress, options.steps))
        adam_step(state, gradients, options, rates, step.number)

    def score(self, state: DeviceState) -> float:
        half = self.photos[1]
        views = range(len(half))
        return self._score_images([draw_black(state.shape, state_colors(state, half, i), half, i) for i in views])

    def _score_images(self, images: list[Tensor]) -> float:
        options = self.plan.job.options
        if options.fit == "none" or not options.judged:  # nothing is held out
            return float("nan")
        weights = to_device(np.stack(self.plan.weights), self.device)
        return score_blocks(torch.stack(images), self.photos[1].images, weights, options.tuning.min_gain)

    def error_masses(self, state: State) -> np.ndarray:
        there, half = self.start(state), self.photos[1]
        masses = torch.zeros(len(there), dtype=torch.float64, device=self.device)
        for view in range(len(half)):
            image, transpose, _ = draw_and_transpose(there.shape, state_colors(there, half, view), half, view)
            error = (image - half.images[view]).abs().mean(-1, keepdim=True)
            masses += transpose(error.expand_as(image))[:, 0]
        return as_array(masses)

    def fit_colors(self, gaussians: Gaussians) -> FitResult:
        options, there = self.plan.job.options, upload_gaussians(gaussians, self.device)
        system = color_system(there, self.photos[1], options, self.plan.job.seed)
        start = torch.zeros(len(gaussians), 3, dtype=torch.float64, device=self.device)
        return fit_offsets(gaussians, system, start, options)

    def photo_error(self, gaussians: Gaussians) -> float:
        there, photos, errors = upload_gaussians(gaussians, self.device), self.photos[0], []
        for view, photo in enumerate(photos.images):
            image = draw_gaussians(there, photos, view).clamp(0, 1)
            errors.append((image - photo).square().mean(dtype=torch.float64))
        return float(torch.stack(errors).mean())


def make_backend(device: torch.device) -> FitBackend:
    """Return the back end of one CUDA device."""
    name = "cuda" if device.type == "cuda" else "cpu"
    scores = partial(measure_photos, device=device)
    return FitBackend(name, partial(_GpuEngine, device=device), scores, (torch.cuda.OutOfMemoryError,))


def state_colors(state: DeviceState, photos: DevicePhotos, view: int) -> Tensor:
    """Return the colours ``[n,3]`` of a state's Gaussians in a view."""
    if state.shN.shape[1] == 0:
        return state.colors
    return harmonic_colors(state.means, ((state.colors - 0.5) / SH_C0)[:, None], state.shN, photos, view)


def measure_photos(
    gaussians: Gaussians,
    photos: Photos,
    views: Sequence[int],
    *,
    quarter: bool = False,
    covered: Sequence[np.ndarray] | None = None,
    near: float,
    device: torch.device,
) -> PhotoScore:
    """Score Gaussians on the photos of ``views``, rendered on a device; see :func:`gsmerge.raster.photos.score_photos`.

    Gaussians and full-size photos are on the host, in one frame, whose unit ``near`` is in.
    """
    uploaded = upload_gaussians(gaussians, device, dtype=None)  # float32 is too coarse far from the origin
    cameras = Cameras(photos.viewmats, photos.Ks, photos.width, photos.height)
    scores = []
    for i, view in enumerate(views):
        drawn = render(uploaded, cameras[[view]].to(device), near=near)
        opaque = 1 - as_array(drawn.alphas[0])[..., 0] < COVERED if covered is None else covered[i]
        scores.append(score_view(as_array(drawn.images[0]), opaque, photos, view, quarter=quarter))
    return mean_score(scores)
