"""Steps of a full fit: a view is drawn and differentiated, and an Adam step follows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmerge.fit.fit_state import State
from gsmerge.fit.loss import image_gradient
from gsmerge.fit.outside import fog_gradients
from gsmerge.fit.poses import PoseState, start_poses
from gsmerge.fit.prepared_step import StepTables, is_prepared
from gsmerge.fit.schedule import FitPlan, Step, loss_weights, step_sizes
from gsmerge.kernels.gaussians import optimise as kernels
from gsmerge.kernels.raster.blend import MAX_ALPHA
from gsmerge.raster import plan_view
from gsmerge.raster.composite import blend, view_colors
from gsmerge.raster.gradient import Gradients, gradients_of
from gsmerge.raster.photos import Photos
from gsmerge.raster.view_plan import camera_numbers
from gsmerge.runtime.threads import parallel_map, use_threads

ROWS = 16384  # Gaussians per piece of an optimiser step


@dataclass(eq=False)
class Optimiser:
    """Optimiser of a full fit: takes its steps, and moves cameras where the options ask for it."""

    plan: FitPlan
    photos: tuple[Photos, ...]  # Those of the plan's job, at the poses of the moment
    poses: PoseState | None  # The motions of the cameras; None where they are fixed
    tables: StepTables | None = None  # Of the state that took the last prepared step

    @property
    def viewmats(self) -> np.ndarray | None:
        """Poses ``[v,4,4]`` that the fit has moved; None if cameras are fixed."""
        return None if self.poses is None else self.poses.viewmats

    def step(self, state: State, step: Step) -> float:
        """Take one Adam step on one view, in place; return the mean squared error of its training pixels."""
        photos, mode, opacities = self.photos[step.mode.size], step.mode, None
        weight = self.plan.step_weights[mode.size][step.view]
        if step.kept is not None:
            fuller = state.splats.opacities / np.float32(1 - self.plan.dropout)
            opacities = step.kept * np.minimum(fuller, MAX_ALPHA)
        error = self._take_prepared(state, step, weight, opacities)
        if error is not None:
            return error / max(3 * float(weight.sum()), 1)
        camera = photos.camera(step.view) | {"eps2d": mode.eps2d, "antialiased": mode.antialiased}
        drawn = plan_view(state.splats, **camera, opacities=opacities)
        all_colors = state.view_colors()
        colors = view_colors(drawn) if all_colors is None else all_colors.take(drawn.ids, 0)
        image, transmittance = blend(drawn, colors, step.background)
        rates = self.plan.job.options.tuning
        weights = loss_weights(rates, step.progress)
        gradient, error = image_gradient(image, photos.image(step.view), weight, *weights)
        with_viewmat = self.poses is not None
        g = gradients_of(drawn, colors, image, transmittance, gradient, None, with_viewmat=with_viewmat)
        if self.poses is not None and g.viewmat is not None:  # that harmonics change with the camera is left out
            self.poses.step(step.view, g.viewmat, rates, step.progress)
        self._move(state, g, step)
        return error / max(3 * float(weight.sum()), 1)

    def _take_prepared(
        self, state: State, step: Step, weight: np.ndarray, opacities: np.ndarray | None
    ) -> float | None:
        """Take a step in few calls and return its error; None if it has to be taken by single calls."""
        if self.poses is not None or not is_prepared(state):
            return None
        with use_threads() as threads:
            tables = self.tables
            if tables is None or tables.state is not state or tables.threads != threads:
                tables = self.tables = StepTables(state, threads)
            mode, photos = step.mode, self.photos[step.mode.size]
            camera = photos.camera(step.view) | {"eps2d": mode.eps2d, "antialiased": mode.antialiased}
            rates = self.plan.job.options.tuning
            numbers = self._constants(state, step) | {
                "camera": camera_numbers(**camera),
                "background": step.background,
                "loss_weights": np.array(loss_weights(rates, step.progress), np.float32),
            }
            drawn = state.splats.opacities if opacities is None else opacities
            return tables.take(
                step.number, np.ascontiguousarray(photos.image(step.view), np.float32), weight, drawn, numbers
            )

    def _constants(self, state: State, step: Step) -> dict[str, np.ndarray]:
        """Return the optimiser's constants at a step."""
        options, count = self.plan.job.options, max(len(state.x), 1)
        rates = options.tuning
        return {
            "rates": step_sizes(rates, step.progress, options.steps),
            "limits": np.array([rates.max_mean_shift, rates.max_scale_change, rates.max_opacity_change], np.float32),
            "betas": np.array([rates.beta1, rates.beta2], np.float32),
            "regs": np.array([rates.opacity_reg / count, rates.scale_reg / count], np.float32),
        }

    def clear_fog(self, state: State, step: Step, view: int) -> None:
        """Take one Adam step against fog: opacity in a view from outside where the start was empty."""
        assert self.plan.job.outside is not None
        self._move(state, fog_gradients(state.splats, self.plan.job.outside, view), step)

    def _move(self, state: State, g: Gradients, step: Step) -> None:
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


def make_optimiser(plan: FitPlan) -> Optimiser:
    """Return the optimiser of a planned fit, with cameras at the poses of the photos."""
    photos = plan.job.photos
    if not plan.job.options.move_cameras:
        return Optimiser(plan, photos, None)
    poses, moving = start_poses(photos)
    return Optimiser(plan, moving, poses)
