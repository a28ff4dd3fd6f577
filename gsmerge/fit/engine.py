"""The engine of a fit, on the CPU or on a GPU: what the loop (:mod:`gsmerge.fit.full`) asks of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from gsmerge.fit.fit_state import State
from gsmerge.fit.report import FitResult
from gsmerge.fit.schedule import FitPlan, Step
from gsmerge.fit.survey import Survey
from gsmerge.raster.photos import PhotoScore
from gsmerge.types import Array, Gaussians


class Engine(Protocol):
    """Draws and fits the photos of one fit on one device; states and images are arrays or tensors of the engine."""

    @property
    def plan(self) -> FitPlan:
        """Plan of the fit."""

    @property
    def viewmats(self) -> np.ndarray | None:
        """Poses ``[v,4,4]`` that the fit has moved; None if cameras are fixed."""

    @property
    def read_every(self) -> int:
        """Number of steps between two reports of progress."""

    def survey(self, gaussians: Gaussians) -> Survey:
        """Draw all half-size photos and collect what they show of each Gaussian; without a fit the score is NaN."""

    def start(self, state: State) -> Any:
        """Copy a state to the engine's device; its parameters are in ``x``."""

    def read(self, state: Any) -> State:
        """Copy a state back from the engine's device."""

    def warm_up(self, state: Any) -> None:
        """Load and compile what steps need, so that their timing is not disturbed."""

    def step(self, state: Any, step: Step) -> Array:
        """Take one Adam step on one view, in place; return the mean squared error of its training pixels."""

    def clear_fog(self, state: Any, step: Step, view: int) -> None:
        """Take one Adam step against fog: opacity that a view from outside shows where the start was empty."""

    def score(self, state: Any) -> float:
        """Return the PSNR (dB) of the held-out blocks of the half-size photos."""

    def error_masses(self, state: State) -> np.ndarray:
        """Sum ``[n]`` blending weight times absolute pixel error of each Gaussian over all half-size photos."""

    def fit_colors(self, gaussians: Gaussians) -> FitResult:
        """Fit base colours alone to the half-size photos, see :func:`gsmerge.fit.color.fit_colors`."""

    def photo_error(self, gaussians: Gaussians) -> float:
        """Return the mean squared error of all full-size photos."""

    def at_poses(self, viewmats: np.ndarray) -> Engine:
        """Return the engine with cameras at poses ``[v,4,4]`` that the fit moves; only the CPU does that."""


@dataclass(frozen=True)
class FitBackend:
    """A device for the fit and the scores: the CPU (``gsmerge.fit.ON_CPU``) or a GPU."""

    device: str  # "cpu" or "cuda"
    make_engine: Callable[[FitPlan], Engine]
    score_photos: Callable[..., PhotoScore]  # see gsmerge.raster.photos.score_photos
    memory_errors: tuple[type[Exception], ...] = ()  # of a device whose memory does not suffice
