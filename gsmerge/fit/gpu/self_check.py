"""Comparison of a device with the CPU on 64 Gaussians, before any work is given to it.

Drivers, gsplat, Triton and torch each come in versions of their own, and not every combination
works. What fails or differs is found here in a moment, and the CPU does the work.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from gsmerge.fit.fit_state import start_state
from gsmerge.fit.gpu.adam import StepGradients, adam_step, step_in_torch, upload_state
from gsmerge.fit.gpu.device_photos import shape_of, upload_gaussians, upload_photos, view_peaks
from gsmerge.fit.schedule import step_sizes
from gsmerge.geometry import normalize, quat_to_rotmat
from gsmerge.raster import cuda
from gsmerge.raster.autograd import Shape, draw_colored, seen_colors
from gsmerge.raster.photos import EPS2D, Photos
from gsmerge.settings.fit import FitOptions
from gsmerge.types import Gaussians

CPU = torch.device("cpu")
COUNT = 64  # Gaussians
WIDTH, HEIGHT = 48, 40  # pixels
# A GPU's fast exponential is off by some millionths, and puts single weights next to 1/255 on the other
# side of the cut. Opacities that are off by a thousandth change image, gradients and weights by 1.5e-4,
# .009 and 6e-4.
MAX_ERRORS = {
    "image": 1e-3,  # root of the mean square, of colours in [0, 1]
    "gradients": 0.02,  # norm of the difference, as a share of the norm
    "blending weights": 5e-3,  # largest difference of a Gaussian's largest weight
    "harmonics": 1e-3,  # largest, of colours
    "optimiser step": 1e-3,  # largest, of parameters that a step moves by .01 to .3
}
GRADIENTS = ("means", "quats", "scales", "opacities", "colors")


def find_difference(device: torch.device) -> str | None:
    """Describe in a clause what a device computes differently from the CPU, or what fails; None if all agrees."""
    try:
        sizes = measure_errors(device)
    except Exception as error:  # of a driver, a compiler or an extension; lack of memory, too
        return f"the self-check of CUDA ended with {cuda.first_line(error)}"
    for name, size in sizes.items():
        if not size <= MAX_ERRORS[name]:  # nor is NaN
            return f"in the self-check of CUDA the {name} differed from the CPU's by {size:.2g}"
    return None


def measure_errors(device: torch.device) -> dict[str, float]:
    """Measure how much a device differs from the CPU in each quantity of ``MAX_ERRORS``."""
    gaussians, photos = make_scene()
    host = upload_gaussians(gaussians, CPU)
    placed = host.to(device)
    resident = upload_photos(photos, device)
    camera = resident.camera(0)
    background = np.array([0.2, 0.5, 0.9], np.float32)

    def draw_on_host(shape: Shape, colors: Tensor) -> tuple[Tensor, Tensor]:
        return draw_colored(shape, colors, photos.camera(0), background)

    def draw_placed(shape: Shape, colors: Tensor) -> tuple[Tensor, Tensor]:
        under = torch.from_numpy(background).to(device)
        image, _, _, reached = cuda.rasterize(shape, colors, camera, under)
        return image, reached

    image, gradients = differentiate(draw_placed, placed)
    expected_image, expected = differentiate(draw_on_host, host)
    pairs = [(getattr(gradients, name).cpu(), getattr(expected, name)) for name in GRADIENTS]
    shares = [(actual - wanted).norm() / wanted.norm() for actual, wanted in pairs]
    peaks, _ = cuda.peak_weights(shape_of(placed), camera)
    expected_peaks = view_peaks(shape_of(host), upload_photos(photos, CPU), 0)
    harmonics = torch.cat([placed.sh0, placed.shN], 1)
    colors = cuda.harmonic_colors(placed.means, harmonics, resident.eyes[0])
    expected_colors = seen_colors(host.means, host.sh0, host.shN, photos.viewmats[0])
    return {
        "image": float((image.cpu() - expected_image).square().mean().sqrt()),
        "gradients": float(torch.stack(shares).max()),
        "blending weights": largest(peaks, expected_peaks),
        "harmonics": largest(colors, expected_colors),
        "optimiser step": compare_steps(gaussians, expected, device),
    }


def make_scene() -> tuple[Gaussians, Photos]:
    """Make random Gaussians, a few of them behind the camera, for comparing devices; no alpha is clamped."""
    rng = np.random.default_rng(0)
    means = rng.uniform(-0.9, 0.9, (COUNT, 3)).astype(np.float32)
    means[::16, 2] -= 6
    gaussians = Gaussians(
        means=means,
        quats=normalize(rng.standard_normal((COUNT, 4), np.float32)),
        scales=rng.uniform(0.03, 0.3, (COUNT, 3)).astype(np.float32),
        opacities=rng.uniform(0.1, 0.8, COUNT).astype(np.float32),
        sh0=rng.standard_normal((COUNT, 1, 3), np.float32),
        shN=0.3 * rng.standard_normal((COUNT, 3, 3), np.float32),
    )
    K = np.array([[40.0, 0, 23.3], [0, 42.0, 20.6], [0, 0, 1]])
    viewmat = np.eye(4)
    viewmat[:3, :3] = quat_to_rotmat(normalize(np.array([[1.0, 0.1, -0.2, 0.05]])))[0]
    viewmat[:3, 3] = 0.1, -0.05, 3.0
    black = np.zeros((1, HEIGHT, WIDTH, 3), np.float32)
    return gaussians, Photos(black, viewmat[None], K[None], EPS2D)


def differentiate(
    draw: Callable[[Shape, Tensor], tuple[Tensor, Tensor]], gaussians: Gaussians
) -> tuple[Tensor, StepGradients]:
    """Draw Gaussians in base colours; return the image and the gradients of a random weighted sum of its values."""
    with torch.enable_grad():
        colors = 0.5 + 0.5 * gaussians.sh0[:, 0]
        means, quats, scales, opacities, colors = (
            tensor.detach().requires_grad_() for tensor in (*shape_of(gaussians), colors)
        )
        image, reached = draw((means, quats, scales, opacities), colors)
        wanted = np.random.default_rng(1).standard_normal(image.shape, np.float32)
        leaves = means, quats, scales, opacities, colors
        rows = torch.autograd.grad(image, leaves, torch.from_numpy(wanted).to(image))
    used = [torch.where(reached.view(-1, *[1] * (row.ndim - 1)), row, 0) for row in rows]  # as a step does
    return image.detach(), StepGradients(used[0], used[1], used[2], used[3], used[4], reached)


def compare_steps(gaussians: Gaussians, gradients: StepGradients, device: torch.device) -> float:
    """Take one optimiser step on the CPU and on a device; return the largest difference."""
    options, start = FitOptions(), start_state(gaussians)
    rates = torch.from_numpy(step_sizes(options.tuning, 0.0, options.steps))
    state, other = upload_state(start, CPU), upload_state(start, device)
    step_in_torch(state, gradients, options, rates, 1)
    uploaded = StepGradients(*(tensor.to(device) for tensor in vars(gradients).values()))
    adam_step(other, uploaded, options, rates.to(device), 1)
    return largest(other.x, state.x)


def largest(values: Tensor, expected: Tensor) -> float:
    """Return the largest absolute difference between a tensor on a device and one on the CPU."""
    return float((values.cpu() - expected).abs().max())
