"""The slow, obvious twin of a step of the full fit calls one kernel after the other."""

from __future__ import annotations

import numpy as np

from gsmerge.method.fit.fit_state import FitState
from gsmerge.method.fit.schedule import Step
from gsmerge.method.fit.steps import Optimiser
from gsmerge.method.kernels.gaussians.optimise import adam
from gsmerge.method.kernels.raster import step as step_kernels
from gsmerge.method.raster import tile_view
from gsmerge.method.raster.composite import blend, view_colors
from gsmerge.method.raster.gradient import Gradients, gradients_of


def step_slowly(optimiser: Optimiser, state: FitState, step: Step) -> float:
    """Take one Adam step on one view, in place, and return the mean squared error, as :meth:`Optimiser.step` does."""
    photo, camera = optimiser.select_view(step)
    tiled = tile_view(state.splats, **camera, opacities=optimiser.drawn_opacities(state, step))
    state.update_harmonics()
    colors = view_colors(tiled) if state.splats.shN.shape[1] else state.colors[tiled.ids]
    image, transmittance = blend(tiled, colors, step.background)
    rates, weight = optimiser.run.job.options.tuning, optimiser.run.weight(step)
    gradient, error = image_gradient(image, photo, weight, rates.ssim_lambda, rates.edge_weight * step.progress)
    moves_camera = optimiser.poses is not None
    g = gradients_of(tiled, colors, image, transmittance, gradient, None, with_viewmat=moves_camera)
    move_slowly(optimiser, state, g[~state.fixed[g.ids]], step)
    if moves_camera:  # harmonics change with the camera as well, which is left out
        optimiser.poses.step(step.view, g.viewmat, rates, step.progress)
    return error / max(3 * float(weight.sum()), 1)


def move_slowly(optimiser: Optimiser, state: FitState, g: Gradients, step: Step) -> None:
    """Take one Adam step along gradients, in place, on one thread."""
    s, none_fixed = state.splats, np.zeros(len(state.x), np.uint8)
    adam(
        state.x, state.x0, state.m, state.v, state.units, state.box_shares, state.min_sizes, none_fixed, g.ids,
        g.means, g.quats, g.scales, g.opacities, g.colors, *optimiser.constants(state, step).values(), step.number,
        0, len(g.ids), s.means, s.quats, s.scales, s.opacities, state.colors,
    )  # fmt: skip


def image_gradient(
    image: np.ndarray, photo: np.ndarray, weight: np.ndarray, ssim_lambda: float, edge_weight: float = 0.0
) -> tuple[np.ndarray, float]:
    """Return the gradient ``[h,w,3]`` of the fit's loss on an image ``[h,w,3]``, and the sum of squared errors."""
    height, width = weight.shape
    gradient, errors = np.empty((height, 3 * width), np.float32), np.empty(height, np.float32)
    flat, goal = (np.ascontiguousarray(a, np.float32).reshape(height, -1) for a in (image, photo))
    differentiate_rows(flat, goal, weight, ssim_lambda, edge_weight, 0, height, gradient, errors)
    return gradient.reshape(height, width, 3), float(errors.sum(dtype=np.float64))


def differentiate_rows(
    image: np.ndarray, photo: np.ndarray, weight: np.ndarray, ssim_lambda: float, edge_weight: float,
    first: int, last: int, gradient: np.ndarray, errors: np.ndarray,
) -> None:  # fmt: skip
    """Call the loss kernel on a range of rows of ``[h,3w]`` images, with buffers of its own."""
    room, weights = step_kernels.room_of(weight.shape[1]), (np.float32(ssim_lambda), np.float32(edge_weight))
    terms = np.empty((step_kernels.DERIVATIVE_ROWS, step_kernels.TERMS, room), np.float32)
    rows = np.empty((step_kernels.EDGE_ROWS, room), np.float32)
    step_kernels.loss_gradient(image, photo, weight, *weights, first, last, gradient, errors, terms, rows)
