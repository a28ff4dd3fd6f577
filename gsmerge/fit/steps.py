"""Steps of a full fit: a view is drawn and differentiated, and an Adam step follows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from gsmerge.fit.fit_state import FitState
from gsmerge.fit.loss import image_gradient
from gsmerge.fit.outside import veil_gradients
from gsmerge.fit.prepared_step import StepTables, is_prepared
from gsmerge.fit.schedule import GROWTH, FitRun, Step, first_decay, loss_weights, step_sizes
from gsmerge.geometry import motion_matrices
from gsmerge.kernels.elementary import log, power
from gsmerge.kernels.gaussians import optimise as kernels
from gsmerge.kernels.matrices import matmul
from gsmerge.kernels.raster.blend import MAX_ALPHA
from gsmerge.raster import tile_view
from gsmerge.raster.composite import blend, view_colors
from gsmerge.raster.gradient import Gradients, gradients_of
from gsmerge.raster.photos import Photos
from gsmerge.raster.tiled_view import camera_numbers
from gsmerge.runtime.threads import parallel_map, use_threads
from gsmerge.settings.fit import Tuning

ROWS = 16384  # Gaussians per piece of an optimiser step
EPS = 1e-15  # of Adam


@dataclass(eq=False)
class PoseState:
    """Motions of the cameras under optimisation; their mean stays zero, so that the scene does not drift."""

    start: np.ndarray  # [v,4,4] viewmats before the fit
    viewmats: np.ndarray  # [v,4,4] float64, updated by steps, shared with all photos
    # [v,6] motion of each, see gsmerge.geometry.motion_vectors: about the scene's middle, where
    # turns and shifts of a camera show differently
    x: np.ndarray
    m: np.ndarray  # First moment
    v: np.ndarray  # Second moment
    counts: np.ndarray  # [v] steps of each
    pixel: float  # Angle of a pixel, radians; also its size at the scene's depth

    def step(self, view: int, gradient: np.ndarray, rates: Tuning, progress: float) -> None:
        """Take one Adam step of a view by the gradient ``[4,4]`` of its viewmat; steps fall to zero at the end."""
        turns = matmul(self.viewmats[view, :3, :3].T, gradient[:3])
        (_, ab, ac), (ba, _, bc), (ca, cb, _) = turns[:, :3]
        slope = np.array([cb - bc, ac - ca, ba - ab, *turns[:, 3]])
        self.counts[view] += 1
        betas = first_decay(rates, self.counts[view]), rates.beta2
        for moment, beta, value in zip((self.m, self.v), betas, (slope, slope**2), strict=True):
            moment[view] += (1 - beta) * (value - moment[view])
        ahead = betas[0] * self.m[view] + (1 - betas[0]) * slope
        first_left, second_left = power(betas, self.counts[view] + np.array([1, 0]))
        first, second = ahead / (1 - first_left), self.v[view] / (1 - second_left)
        self.x[view] -= rates.poses_lr * self.pixel * (1 - progress) * first / (np.sqrt(second) + EPS)
        self.x -= self.x.mean(0)
        self.viewmats[:] = matmul(self.start, motion_matrices(self.x))


def start_poses(photos: tuple[Photos, ...]) -> tuple[PoseState, tuple[Photos, ...]]:
    """Return motions of zero for the photos' cameras, and the photos with viewmats that the motions update."""
    start = photos[0].viewmats.astype(np.float64)
    zero, shared = np.zeros((len(start), 6)), start.copy()
    pixel = 1 / float(photos[0].Ks[:, [0, 1], [0, 1]].mean())
    state = PoseState(start, shared, zero, zero.copy(), zero.copy(), np.zeros(len(start), np.int64), pixel)
    return state, tuple(replace(level, viewmats=shared) for level in photos)


@dataclass(eq=False)
class Optimiser:
    """Optimiser of a full fit: takes its steps, and moves cameras where the options ask for it."""

    run: FitRun
    photos: tuple[Photos, ...]  # Those of the run's job, at the poses of the moment
    poses: PoseState | None  # The motions of the cameras; None where they are fixed
    tables: StepTables | None = None  # Of the state that took the last prepared step

    @property
    def viewmats(self) -> np.ndarray | None:
        """Poses ``[v,4,4]`` that the fit has moved; None if cameras are fixed."""
        return None if self.poses is None else self.poses.viewmats

    def step(self, state: FitState, step: Step) -> float:
        """Take one Adam step on one view, in place; return the mean squared error of its training pixels."""
        opacities, weight = None, self.run.weight(step)
        if step.kept is not None:
            fuller = state.splats.opacities / np.float32(1 - self.run.dropout)
            opacities = step.kept * np.minimum(fuller, MAX_ALPHA)
        error = self._take_prepared(state, step, weight, opacities)
        if error is not None:
            return error / max(3 * float(weight.sum()), 1)
        photo, camera = self._look(step)
        drawn = tile_view(state.splats, **camera, opacities=opacities)
        all_colors = state.view_colors()
        colors = view_colors(drawn) if all_colors is None else all_colors.take(drawn.ids, 0)
        image, transmittance = blend(drawn, colors, step.background)
        rates = self.run.job.options.tuning
        weights = loss_weights(rates, step.progress)
        gradient, error = image_gradient(image, photo, weight, *weights)
        with_viewmat = self.poses is not None
        g = gradients_of(drawn, colors, image, transmittance, gradient, None, with_viewmat=with_viewmat)
        if self.poses is not None and g.viewmat is not None:  # that harmonics change with the camera is left out
            self.poses.step(step.view, g.viewmat, rates, step.progress)
        self._move(state, g, step)
        return error / max(3 * float(weight.sum()), 1)

    def _look(self, step: Step) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the pixels ``[h,w,3]`` float32 of a photo that a step draws, and the camera that draws them."""
        photos, mode, sample = self.photos[step.mode.size], step.mode, step.sample
        camera = photos.camera(step.view, sample)
        camera |= {"eps2d": mode.eps2d / sample.stride**2, "antialiased": mode.antialiased}
        return np.ascontiguousarray(photos.image(step.view, step.background, sample), np.float32), camera

    def _take_prepared(
        self, state: FitState, step: Step, weight: np.ndarray, opacities: np.ndarray | None
    ) -> float | None:
        """Take a step in few calls and return its error; None if it has to be taken by single calls."""
        if self.poses is not None or not is_prepared(state):
            return None
        with use_threads() as threads:
            tables = self.tables
            if tables is None or tables.state is not state or tables.threads != threads:
                tables = self.tables = StepTables(state, threads)
            photo, camera = self._look(step)
            rates = self.run.job.options.tuning
            numbers = self._constants(state, step) | {
                "camera": camera_numbers(**camera),
                "background": step.background,
                "loss_weights": np.array(loss_weights(rates, step.progress), np.float32),
            }
            drawn = state.splats.opacities if opacities is None else opacities
            return tables.take(step.number, photo, weight, drawn, numbers)

    @cached_property
    def _limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Limits of parameters before the growth of a run, where none come that could fill what is cut, and after."""
        rates = self.run.job.options.tuning
        moves = rates.max_mean_shift, rates.max_scale_change, rates.max_opacity_change
        widest = max(photos.width for photos in self.run.job.photos)  # of the size whose pixels the least scale counts
        ratio, long = log(np.array([rates.max_ratio, rates.long_share * widest / (3 * max(rates.min_scale, 1e-9))]))
        before, after = (np.array([*moves, most, long], np.float32) for most in (np.inf, ratio))
        return before, after

    def _constants(self, state: FitState, step: Step) -> dict[str, np.ndarray]:
        """Return the optimiser's constants at a step."""
        options, count = self.run.job.options, max(len(state.x), 1)
        rates, looks = options.tuning, step.number / len(self.photos[0])
        return {
            "rates": step_sizes(rates, step.progress, options.steps),
            "limits": self._limits[options.grows and step.progress >= GROWTH],
            "betas": np.array([first_decay(rates, looks), rates.beta2], np.float32),
            "regs": np.array([rates.opacity_reg / count, rates.scale_reg / count], np.float32),
        }

    def clear_veils(self, state: FitState, step: Step, view: int) -> None:
        """Take one Adam step against fog and veils in a view from outside."""
        assert self.run.job.outside is not None
        self._move(state, veil_gradients(state.splats, self.run.job.outside, view), step)

    def _move(self, state: FitState, g: Gradients, step: Step) -> None:
        """Take one Adam step along gradients."""
        s = state.splats
        if state.fixed.any():
            g = g[~state.fixed[g.ids]]
        constants = tuple(self._constants(state, step).values())

        def update(first: int) -> None:
            last = min(first + ROWS, len(g.ids))
            kernels.adam(
                state.x, state.x0, state.m, state.v, state.units, state.box_shares, state.min_sizes, g.ids,
                g.means, g.quats, g.scales, g.opacities, g.colors, *constants, step.number, first, last,
                s.means, s.quats, s.scales, s.opacities, state.colors,
            )  # fmt: skip

        parallel_map(update, range(0, len(g.ids), ROWS))


def make_optimiser(run: FitRun) -> Optimiser:
    """Return the optimiser of a fit; its cameras are where the photos were taken."""
    photos = run.job.photos
    if not run.job.options.move_cameras:
        return Optimiser(run, photos, None)
    poses, moving = start_poses(photos)
    return Optimiser(run, moving, poses)
