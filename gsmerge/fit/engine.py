"""Where a fit runs: what its loop (:mod:`gsmerge.fit.full`) asks of an engine, on the CPU or on a GPU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from gsmerge.fit.fit_state import State
from gsmerge.fit.report import FitResult
from gsmerge.fit.schedule import FitPlan, Step
from gsmerge.fit.survey import Survey
from gsmerge.types import Array, Gaussians


class Engine(Protocol):
    """Photos of one fit with what draws into them; states and images are an engine's own, arrays or tensors."""

    @property
    def plan(self) -> FitPlan:
        """Plan of the fit."""

    @property
    def viewmats(self) -> np.ndarray | None:
        """Poses ``[v,4,4]`` that steps have moved to; None: fixed."""

    @property
    def read_every(self) -> int:
        """Steps from one report of progress to the next."""

    def survey(self, gaussians: Gaussians) -> Survey:
        """Look once at all half-size photos; without a fit the score is not measured, NaN."""

    def start(self, state: State) -> Any:
        """Bring a state to the engine; its parameters are in ``x``."""

    def read(self, state: Any) -> State:
        """Bring a state back."""

    def warm_up(self, state: Any) -> None:
        """Load what steps need, before they are timed."""

    def step(self, state: Any, step: Step) -> Array:
        """Take one Adam step on one view, in place; return the mean squared error of its training pixels."""

    def clear_fog(self, state: Any, step: Step, view: int) -> None:
        """Take one Adam step against what shows in a view from outside where the start shows nothing."""

    def score(self, state: Any) -> float:
        """Return the PSNR (dB) of the held-out blocks of the half-size photos."""

    def error_masses(self, state: State) -> np.ndarray:
        """Sum ``[n]`` each Gaussian's blending weight times the pixel's absolute error over all half-size photos."""

    def fit_colors(self, gaussians: Gaussians) -> FitResult:
        """Fit base colours alone to the half-size photos, see :func:`gsmerge.fit.color.fit_colors`."""

    def photo_error(self, gaussians: Gaussians) -> float:
        """Return the mean squared error of all full-size photos."""

    def at_poses(self, viewmats: np.ndarray) -> Engine:
        """Return the engine with its views at poses ``[v,4,4]``, which steps move on; only the CPU does that."""


@dataclass(frozen=True)
class FitBackend:
    """Where the fit and the scores run: on the CPU (``gsmerge.fit.ON_CPU``) or on a GPU."""

    device: str  # "cpu" or "cuda"
    make_engine: Callable[[FitPlan], Engine]
    photo_psnr: Callable[..., float]  # see gsmerge.raster.photos.photo_psnr
    memory_errors: tuple[type[Exception], ...] = ()  # of a device whose memory does not suffice
