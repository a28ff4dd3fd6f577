"""Settings of the fit to the photos."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from gsmerge.settings.setting import Settings, setting

Fit = Literal["full", "none"]
STEPS = 320  # of the full fit
LONG_STEPS = 600  # from here on a little dropout pays
USUAL_SHARE = 0.044  # of Gaussians in the pixels, which a quarter of these shows well
HASTY_STEPS = 20  # shorter runs have no time for full-size photos
GROW_STEPS = 150  # shorter runs do better when they begin with all that they may have


@dataclass(frozen=True)
class Tuning:
    """Constants of the fit, chosen on training scenes; tests and research change them."""

    means_lr: float = 0.1  # Step of a mean, in units of the Gaussian's size
    scales_lr: float = 0.2  # Step of a log scale
    quats_lr: float = 0.03  # Step of a quaternion
    opacities_lr: float = 0.3  # Step of an opacity's logit
    colors_lr: float = 0.03  # Step of a colour, sRGB in [0, 1]
    poses_lr: float = 0.1  # First step of a moved camera: turns and shifts by so many pixels
    decay: float = 0.4  # Factor on the other steps at the end; less beyond 300 steps
    beta1: float = 0.8  # Largest decay of Adam's first moment, see gsmerge.fit.schedule.first_decay
    beta2: float = 0.9  # Decay of its second moment
    max_mean_shift: float = 2.0  # Largest shift of a mean, in units of the Gaussian's size
    max_scale_change: float = 2.5  # Largest change of a log scale
    max_opacity_change: float = 4.0  # Largest change of an opacity's logit
    # Share of the limits of mean and scales for a Gaussian that one photo alone shows: that photo
    # says what it looks like, not where it is. From two photos on the limits are whole
    single_view_share: float = 0.3
    # Least scale, in pixels of the photo that a Gaussian is nearest to: thinner ones show as
    # needles when a viewer enlarges them. 0 for none
    min_scale: float = 0.5
    # Gaussians whose three sigma reach this share of the width of the nearest photo are at most so
    # many times as long as their second axis, once a run has grown: from elsewhere longer ones show
    # as strokes. Before, they help few Gaussians to find their places
    long_share: float = 0.25
    max_ratio: float = 3.0
    average_share: float = 0.2  # Share of the last steps that the parameters are averaged over
    ssim_lambda: float = 0.35  # Share of structural similarity in the loss, the rest is L1
    # Weight in the loss, at the end, of the L1 of differences between neighbouring pixels; it
    # grows from 0: edges say little where they lie elsewhere
    edge_weight: float = 2.4
    # Weight of the mean opacity in the loss of the full fit (3DGS-MCMC, Kheradmand et al. 2024):
    # what the photos do not need fades, instead of standing in front of other views
    opacity_reg: float = 0.03
    # The same of the mean size, in units of each Gaussian's own at its start: fewer of them
    # overlap, and a step takes a third less time
    scale_reg: float = 0.01
    outside_every: int = 7  # Steps from one look from outside to the next, see gsmerge.fit.outside
    # Share of the steps that come before them, 1 for none; what hangs in gaps early on helps the rest
    outside_from: float = 0.15
    iterations: int = 6  # Conjugate-gradient steps of the colour fit
    prior_weight: float = 0.03  # Weight of the unfitted colours, relative to visibility
    huber: float = 0.2  # Colour error beyond which a pixel counts less in the colour fit
    # Exposure of a view against the mean, as a factor, from which on the colour fit compensates it;
    # smaller differences come from holes and highlights as often as from the camera
    min_gain: float = 1.15
    max_gain: float = 2.0  # Largest exposure factor that is believed

    def scaled(self, factor: float) -> Tuning:
        """Return the same constants with ``factor`` times the step sizes of Gaussians."""
        names = ("means_lr", "scales_lr", "quats_lr", "opacities_lr", "colors_lr")
        return replace(self, **{name: factor * getattr(self, name) for name in names})


@dataclass(frozen=True)
class FitOptions(Settings):
    """Settings of the fit to the photos."""

    fit: Fit = setting("full", "full: closer to the photos, for most of the time that a run takes; none: neither.")
    fit_steps: int | None = setting(None, "Steps of the full fit, one view each.",
        "By default 320, and by effort and numbers of views and Gaussians.", least=1)  # fmt: skip
    time_budget: float | None = setting(None, "Seconds after which the full fit stops.",
        "The result is then no longer the same on every machine. By default there is no limit.", above=0,
        unit="seconds", in_trial=None)  # fmt: skip
    photo_scale: float | Literal["auto"] = setting("auto", "Times the views' size at which two of every five steps "
        "after the first ones look at larger photos, as far as the photos are that large.",
        "`auto`: up to 2 with effort `default` and `best`.", least=1, below=math.inf, in_trial=1.0)  # fmt: skip
    dropout: float | None = setting(None, "Share of the Gaussians that a step leaves out.",
        "By default 0.1 for at most five views and at least 150 steps, 0.05 from 600 steps and 30 looks at each view "
        "on, otherwise 0.", least=0, below=1)  # fmt: skip
    half_res_share: float | None = setting(None, "Share of the steps, the first ones, that draw a quarter of the "
        "pixels.", "By default 0.7, from 600 steps on 0.5, below 20 all; less for more than 4.4 % of the "
        "Gaussians.", least=0, most=1)  # fmt: skip
    holdout: float = setting(0.05, "Share of the photos' patches that decides whether a fit is accepted.", above=0,
        below=1)  # fmt: skip
    min_contribution: float = setting(1 / 255, "Least blending weight at some pixel of some photo; a fit leaves out "
        "Gaussians below it in all photos that they lie in. 0: all Gaussians are written, also those that change no "
        "photo by more than rounding.", least=0, most=1)  # fmt: skip
    judged: bool = setting(True, "Whether the result has to show held-out patches better than its start; not where the "
        "start has seen them.", internal=True)  # fmt: skip
    move_cameras: bool = setting(False, "Whether the full fit moves the cameras on; a plan decides it by `poses`.",
        internal=True)  # fmt: skip
    beyond: bool = setting(False, "Whether Gaussians may reach beyond all views; a plan decides it by `extent`.",
        internal=True)  # fmt: skip
    fills: bool = setting(False, "Whether others take the places of Gaussians that nobody sees; a plan decides it by "
        "`budget`.", internal=True)  # fmt: skip
    share: float | None = setting(None, "Gaussians of the result for each pixel; a plan knows it.",
        "By default 0.044.", internal=True)  # fmt: skip
    tuning: Tuning = setting(Tuning(), "Constants.", internal=True)

    @property
    def steps(self) -> int:
        """Number of steps of the full fit."""
        return STEPS if self.fit_steps is None else self.fit_steps

    @property
    def half_res_part(self) -> float:
        """Share of the steps, the first ones, that draw a quarter of the pixels."""
        if self.half_res_share is not None:
            return self.half_res_share
        if self.steps < HASTY_STEPS:
            return 1.0
        most = 0.5 if self.steps >= LONG_STEPS else 1.0  # details come last, and long runs have time for them
        share = 1.0 if self.share is None or not self.grows else self.share / USUAL_SHARE
        return min(most, 0.7 / math.sqrt(max(share, 1.0)))

    @property
    def grows(self) -> bool:
        """Whether the fit starts with fewer Gaussians than requested, and adds the rest during its steps."""
        return self.fit == "full" and self.steps >= GROW_STEPS
