"""Take the steps of a full fit: draw a view, differentiate the loss, and take an Adam step. Cameras may move, too."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from gsmerge.method.fit.fit_state import FitState
from gsmerge.method.fit.schedule import GROWTH, FitRun, Step, first_decay, step_sizes
from gsmerge.method.fit.step_buffers import StepBuffers
from gsmerge.method.geometry.transforms import camera_centres, motion_matrices
from gsmerge.method.kernels.elementary import log, power
from gsmerge.method.kernels.gaussians import optimise as kernels
from gsmerge.method.kernels.matrices import matmul
from gsmerge.method.kernels.raster.blend import MAX_ALPHA
from gsmerge.method.raster.gradient import Gradients
from gsmerge.method.raster.photos import Photos
from gsmerge.method.raster.tiled_view import camera_numbers
from gsmerge.runtime.threads import parallel_map, use_threads
from gsmerge.settings.fit import Tuning

ADAM_ROWS = 16384  # Gaussians per task of an Adam step


@dataclass(eq=False)
class PoseState:
    """Motions of the cameras during a fit. The mean of the motions stays zero, so that the scene does not drift."""

    start: np.ndarray  # [v,4,4] viewmats before the fit
    viewmats: np.ndarray  # [v,4,4] float64; steps update it in place, and all sizes of the photos share it
    # [v,6] motion of each camera, see transforms.motion_vectors. Cameras rotate about the middle of the scene, because
    # a rotation of a camera about its own centre looks like a shift
    x: np.ndarray
    m: np.ndarray  # [v,6] first moments of Adam
    v: np.ndarray  # [v,6] second moments of Adam
    counts: np.ndarray  # [v] number of steps that each camera has taken
    pixel: float  # Angle of a pixel in radians, which is also its size at the middle depth of the scene

    def step(self, view: int, gradient: np.ndarray, rates: Tuning, progress: float) -> None:
        """Move a view by one Adam step (Nadam) down the gradient ``[4,4]`` of its viewmat, and update all viewmats.

        ``progress`` is the share of the fit that is done. The size of the steps falls to zero at the end of the fit.
        """
        local = matmul(self.viewmats[view, :3, :3].T, gradient[:3])
        (_, xy, xz), (yx, _, yz), (zx, zy, _) = local[:, :3]
        slope = np.array([zy - yz, xz - zx, yx - xy, *local[:, 3]])  # derivatives by the rotation vector and the shift
        self.counts[view] += 1
        betas = first_decay(rates, self.counts[view]), rates.beta2
        for moments, beta, sample in zip((self.m, self.v), betas, (slope, slope**2), strict=True):
            moments[view] += (1 - beta) * (sample - moments[view])
        next_m = betas[0] * self.m[view] + (1 - betas[0]) * slope  # Nesterov's look-ahead
        bias_m, bias_v = power(betas, self.counts[view] + np.array([1, 0]))
        m_hat = next_m / (1 - bias_m)
        v_hat = self.v[view] / (1 - bias_v)
        eps = 1e-15  # added to the denominator of Adam's step
        self.x[view] -= rates.poses_lr * self.pixel * (1 - progress) * m_hat / (np.sqrt(v_hat) + eps)
        self.x -= self.x.mean(0)
        self.viewmats[:] = matmul(self.start, motion_matrices(self.x))


@dataclass(eq=False)
class Optimiser:
    """The optimiser of a full fit, which changes Gaussians, and also cameras if the options ask for it."""

    run: FitRun
    photos: tuple[Photos, ...]  # Photos of the job at each size, at the poses that the fit has reached
    poses: PoseState | None  # Motions of the cameras; None if cameras are fixed
    buffers: StepBuffers | None = None  # Buffers of the last step, which fit only its state

    @property
    def viewmats(self) -> np.ndarray | None:
        """Poses ``[v,4,4]`` of the cameras that the fit moves, or None if cameras are fixed."""
        return None if self.poses is None else self.poses.viewmats

    def step(self, state: FitState, step: Step) -> float:
        """Change a state by one Adam step on one view; return the weighted mean squared error of the pixels."""
        rates = self.run.job.options.tuning
        weight = self.run.weight(step)
        photo, camera = self.select_view(step)
        numbers = self.constants(state, step) | {
            "camera": camera_numbers(**camera),
            "eye": camera_centres(camera["viewmat"].astype(np.float64)),
            "background": step.background,
            "loss_weights": np.array([rates.ssim_lambda, rates.edge_weight * step.progress], np.float32),
        }
        with use_threads() as threads:
            # the buffers of the last step fit only its state and its number of threads
            if self.buffers is None or self.buffers.state is not state or self.buffers.threads != threads:
                self.buffers = StepBuffers(state, threads, self.poses is not None)
            error, viewmat_gradient = self.buffers.take_step(
                step.number, photo, weight, self.drawn_opacities(state, step), numbers
            )
        if self.poses is not None and viewmat_gradient is not None:
            self.poses.step(step.view, viewmat_gradient, rates, step.progress)
        return error / max(3 * float(weight.sum()), 1)

    def move(self, state: FitState, g: Gradients, step: Step) -> None:
        """Change the Gaussians of a state that have gradients ``g`` by one Adam step."""
        s, fixed, constants = state.splats, state.fixed.view(np.uint8), tuple(self.constants(state, step).values())

        def move_rows(start: int) -> None:
            stop = min(start + ADAM_ROWS, len(g.ids))
            kernels.adam(
                state.x, state.x0, state.m, state.v, state.units, state.box_shares, state.min_sizes, fixed, g.ids,
                g.means, g.quats, g.scales, g.opacities, g.colors, *constants, step.number, start, stop,
                s.means, s.quats, s.scales, s.opacities, state.colors,
            )  # fmt: skip

        parallel_map(move_rows, range(0, len(g.ids), ADAM_ROWS))

    def select_view(self, step: Step) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the pixels ``[h,w,3]`` float32 of a photo with which a step compares, and the camera for them."""
        photos = self.photos[step.mode.size]
        mode = step.mode
        sample = step.sample
        camera = photos.camera(step.view, sample)
        camera |= {"eps2d": mode.eps2d / sample.stride**2, "antialiased": mode.antialiased or photos.antialiased}
        return np.ascontiguousarray(photos.image(step.view, step.background, sample), np.float32), camera

    def drawn_opacities(self, state: FitState, step: Step) -> np.ndarray:
        """Return the opacities ``[n]`` that a step draws: 0 where dropout leaves out Gaussians, raised for the rest."""
        if step.mask is None:
            return state.splats.opacities
        raised = state.splats.opacities / np.float32(1 - self.run.dropout)
        return step.mask * np.minimum(raised, MAX_ALPHA)

    def constants(self, state: FitState, step: Step) -> dict[str, np.ndarray]:
        """Return the constants of an Adam step by name, in the order of the arguments of ``kernels.adam``."""
        options = self.run.job.options
        count = max(len(state.x), 1)
        rates = options.tuning
        rounds = step.number / len(self.photos[0])
        return {
            "rates": step_sizes(rates, step.progress, options.steps),
            "limits": self._limits[options.grows and step.progress >= GROWTH],
            "betas": np.array([first_decay(rates, rounds), rates.beta2], np.float32),
            "regs": np.array([rates.opacity_reg / count, rates.scale_reg / count], np.float32),
        }

    @cached_property
    def _limits(self) -> tuple[np.ndarray, np.ndarray]:
        """The limits of the parameters, as ``kernels.adam`` takes them, before and after Gaussians are added.

        Before Gaussians are added, nothing limits how long a Gaussian is relative to its width, because no new
        Gaussians could fill the gaps beside a shorter one.
        """
        rates = self.run.job.options.tuning
        moves = rates.max_mean_shift, rates.max_scale_change, rates.max_opacity_change
        width = max(photos.width for photos in self.run.job.photos)  # pixels
        # Three standard deviations of a Gaussian are at most the share long_share of a photo's width. The limit of a
        # scale is in units of the least scale, which is min_scale pixels
        max_length = rates.long_share * width / (3 * max(rates.min_scale, 1e-9))
        log_ratio, log_length = log(np.array([rates.max_ratio, max_length]))
        before = np.array([*moves, np.inf, log_length], np.float32)
        after = np.array([*moves, log_ratio, log_length], np.float32)
        return before, after


def start_poses(photos: tuple[Photos, ...]) -> tuple[PoseState, tuple[Photos, ...]]:
    """Return cameras that have not moved yet, and the photos of all sizes with the viewmats that steps will update."""
    start = photos[0].viewmats.astype(np.float64)
    count = len(start)
    state = PoseState(
        start=start,
        viewmats=start.copy(),
        x=np.zeros((count, 6)),
        m=np.zeros((count, 6)),
        v=np.zeros((count, 6)),
        counts=np.zeros(count, np.int64),
        pixel=1 / float(photos[0].Ks[:, [0, 1], [0, 1]].mean()),
    )
    return state, tuple(replace(level, viewmats=state.viewmats) for level in photos)


def make_optimiser(run: FitRun) -> Optimiser:
    """Return the optimiser of a fit before its first step, with the cameras where the photos were taken."""
    photos = run.job.photos
    if not run.job.options.move_cameras:
        return Optimiser(run, photos, None)
    poses, moving = start_poses(photos)
    return Optimiser(run, moving, poses)
