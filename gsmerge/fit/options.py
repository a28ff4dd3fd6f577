"""Settings of the fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Fit = Literal["none", "color"]


@dataclass(frozen=True)
class FitOptions:
    """What is fitted to the photos.

    Args:
        fit: ``"color"``: the base colours; ``"none"``: nothing.
        fit_level: Photos are reduced by this factor on each side for the fit.
        iterations: Conjugate-gradient steps.
        pull: Weight of the unfitted colours, relative to how much of each Gaussian is seen.
        huber: Colour error beyond which a pixel counts less (moving things, reflections).
        min_gain: Exposure of a view against the mean, as a factor, from which on it is compensated; smaller
            differences come from holes and highlights as often as from the camera.
        max_gain: Largest exposure factor that is believed.
        holdout: Share of the photos' blocks that decides whether the fit is accepted.
        prune: Leave out Gaussians that contribute less than this to every pixel of every photo that they lie in.

    Raises:
        ValueError: If a setting is unknown or out of range.
    """

    fit: Fit = "color"
    fit_level: int = 2
    iterations: int = 6
    pull: float = 0.03
    huber: float = 0.2
    min_gain: float = 1.15
    max_gain: float = 2.0
    holdout: float = 0.1
    prune: float = 1 / 255

    def __post_init__(self) -> None:
        if self.fit not in ("none", "color"):
            raise ValueError(f'fit: expected "none" or "color", got "{self.fit}"')
        for name in ("fit_level", "iterations"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")
        if not self.pull >= 0:
            raise ValueError(f"pull: expected at least 0, got {self.pull}")
        if not 0 < self.holdout < 1:
            raise ValueError(f"holdout: expected a number between 0 and 1, got {self.holdout}")

    fit_steps: int = 60
    coarse: float = 0.7
    dssim: float = 0.2
    dropout: float = 0.0
    rate_mean: float = 0.1
    rate_size: float = 0.2
    rate_quat: float = 0.03
    rate_logit: float = 0.3
    rate_color: float = 0.03
    decay: float = 0.1
    beta1: float = 0.7
    beta2: float = 0.99
    reach: float = 2.0
    reach_size: float = 2.5
    reach_logit: float = 4.0
