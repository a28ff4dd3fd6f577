"""Settings of the fit."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

Device = Literal["cpu", "cuda", "auto"]
Fit = Literal["none", "color", "full"]
STEPS = {"draft": 12, "fast": 30, "default": 280, "best": 1000}  # of the full fit, by effort
LONG_STEPS = 600  # from here on full-size photos and a little dropout pay
HASTY_STEPS = 20  # shorter runs have no time for full-size photos
GROW_STEPS = 150  # shorter runs do better when they begin with all that they may have


@dataclass(frozen=True)
class Rates:
    """How far a step of the full fit may go, and how far all of them together.

    Args:
        mean: Step of a mean, in units of the Gaussian's size.
        size: Step of a log scale.
        quat: Step of a quaternion.
        logit: Step of an opacity's logit.
        color: Step of a colour, sRGB in [0, 1].
        decay: Factor on all steps at the end of the run; runs of more than 300 steps end lower in proportion.
        beta1: Decay of Adam's first moment.
        beta2: Decay of its second moment.
        reach_mean: Farthest that a mean may go from its start, in units of the Gaussian's size.
        reach_size: Largest change of a log scale.
        reach_logit: Largest change of an opacity's logit.
        reach_alone: Share of the reach of mean and size that a Gaussian has which one photo alone shows: that photo
            says what it looks like, not where it is. From two photos on the reach is whole.
    """

    mean: float = 0.1
    size: float = 0.2
    quat: float = 0.03
    logit: float = 0.3
    color: float = 0.03
    decay: float = 0.2
    beta1: float = 0.7
    beta2: float = 0.99
    reach_mean: float = 2.0
    reach_size: float = 2.5
    reach_logit: float = 4.0
    reach_alone: float = 0.3


@dataclass(frozen=True)
class FitOptions:
    """What is fitted to the photos.

    Args:
        fit: ``"full"``: all parameters; ``"color"``: the base colours; ``"none"``: nothing.
        effort: ``"draft"``, ``"fast"``, ``"default"`` or ``"best"``: what ``fit_steps`` are unless given.
        fit_steps: Steps of the full fit, one view each; None: by effort.
        time_budget: Seconds after which the full fit stops, None for no limit. The steps are then chosen from the
            measured time of the first ones, and the result is no longer the same on every machine.
        dropout: Share of the Gaussians that a step leaves out; None: 0.1 for five views or fewer and 150 steps or
            more, where the photos alone would be learnt by heart, otherwise 0.05 from 600 steps on and 0 below.
        coarse: Share of the steps that look at half-size photos; None: 0.7, from 600 steps on 0.5, below 20 all.
        dssim: Share of structural similarity in the loss, the rest is L1.
        opacity_pull: Weight of the mean opacity in the loss of the full fit (3DGS-MCMC, Kheradmand et al. 2024): what
            the photos do not need fades, instead of standing in front of other views.
        size_pull: The same of the mean size, in units of each Gaussian's own at its start: fewer of them overlap, and
            a step takes a third less time.
        rates: Steps and limits of the full fit.
        iterations: Conjugate-gradient steps of the colour fit.
        pull: Weight of the unfitted colours, relative to how much of each Gaussian is seen.
        huber: Colour error beyond which a pixel counts less (moving things, reflections).
        min_gain: Exposure of a view against the mean, as a factor, from which on the colour fit compensates it;
            smaller differences come from holes and highlights as often as from the camera.
        max_gain: Largest exposure factor that is believed.
        holdout: Share of the photos' blocks that decides whether a fit is accepted.
        prune: Leave out Gaussians that contribute less than this to every pixel of every photo that they lie in.
        device: Where the full fit's steps run: ``"cpu"``; ``"cuda"``, through gsplat, whose sums have no fixed order,
            so that runs differ in the last bits; ``"auto"``: CUDA where it can be used, resolved at once.

    Raises:
        ValueError: If a setting is unknown or out of range, or CUDA is asked for and cannot be used.
    """

    fit: Fit = "full"
    effort: str = "default"
    fit_steps: int | None = None
    time_budget: float | None = None
    dropout: float | None = None
    coarse: float | None = None
    dssim: float = 0.2
    opacity_pull: float = 0.03
    size_pull: float = 0.01
    rates: Rates = field(default_factory=Rates)
    iterations: int = 6
    pull: float = 0.03
    huber: float = 0.2
    min_gain: float = 1.15
    max_gain: float = 2.0
    holdout: float = 0.05
    prune: float = 1 / 255
    device: Device = "cpu"

    @property
    def steps(self) -> int:
        """Steps of the full fit."""
        return STEPS[self.effort] if self.fit_steps is None else self.fit_steps

    @property
    def coarse_share(self) -> float:
        """Share of the steps that look at half-size photos."""
        if self.coarse is not None:
            return self.coarse
        return 1.0 if self.steps < HASTY_STEPS else 0.5 if self.steps >= LONG_STEPS else 0.7

    @property
    def needs_photos(self) -> bool:
        """Whether the photos are looked at: to fit, or to leave out what none of them shows."""
        return self.fit != "none" or (self.prune > 0 and self.effort != "draft")

    @property
    def grows(self) -> bool:
        """Whether the fit begins with fewer Gaussians than are asked for, and adds the rest on the way."""
        return self.fit == "full" and self.steps >= GROW_STEPS

    def __post_init__(self) -> None:
        if isinstance(self.rates, dict):  # as CompactOptions.to_dict() and JSON have it
            object.__setattr__(self, "rates", Rates(**self.rates))
        if self.fit not in ("none", "color", "full"):
            raise ValueError(f'fit: expected "none", "color" or "full", got "{self.fit}"')
        if self.effort not in STEPS:
            raise ValueError(f"effort: expected one of {', '.join(STEPS)}, got {self.effort!r}")
        if self.steps < 1:
            raise ValueError(f"fit_steps: expected at least 1, got {self.steps}")
        if self.iterations < 1:
            raise ValueError(f"iterations: expected at least 1, got {self.iterations}")
        for name in ("pull", "opacity_pull", "size_pull"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: expected at least 0, got {getattr(self, name)}")
        if not 0 < self.holdout < 1:
            raise ValueError(f"holdout: expected a number between 0 and 1, got {self.holdout}")
        for name in ("coarse", "dssim", "prune"):
            value = getattr(self, name)
            if value is not None and not 0 <= value <= 1:
                raise ValueError(f"{name}: expected a number from 0 to 1, got {value}")
        for name in ("min_gain", "max_gain"):
            if not getattr(self, name) >= 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")
        if not self.huber > 0:
            raise ValueError(f"huber: expected more than 0, got {self.huber}")
        if self.dropout is not None and not 0 <= self.dropout < 1:
            raise ValueError(f"dropout: expected a number from 0 to below 1, got {self.dropout}")
        if self.time_budget is not None and not self.time_budget > 0:
            raise ValueError(f"time_budget: expected more than 0 seconds, got {self.time_budget}")
        if self.device not in ("cpu", "cuda", "auto"):
            raise ValueError(f'device: expected "cpu", "cuda" or "auto", got "{self.device}"')
        if self.device != "cpu":
            from gsmerge.render.cuda import usable_device

            object.__setattr__(self, "device", usable_device(self.device))
