"""Declare the settings of the fit to the photos."""

from __future__ import annotations

import math
from typing import Literal

from gsmerge.frozen import dataclass, replace
from gsmerge.settings.setting import Settings, setting

Fit = Literal["full", "none"]
STEPS = 330  # default number of steps of the full fit
LONG_STEPS = 600  # runs with at least this many steps gain from a little dropout
USUAL_SHARE = 0.044  # for this many Gaussians per pixel, a quarter of the pixels is enough in the first steps
# Shares of the steps that draw a quarter of the pixels: of runs that draw samples of photos, and of others, which draw
# half-size photos or, later, larger photos
SAMPLED_HALF = 0.8
USUAL_HALF = 0.7
SAMPLED_STEPS = 30  # shorter runs draw too few samples to see all pixels: they lose .07 dB at 20 steps, 1 dB at 7
GROW_STEPS = 150  # runs with fewer steps do better when they begin with all their Gaussians
# A run grows only if it has at least this many steps for each photo, because each step draws one photo, and each photo
# has to be drawn before the growth. With fewer steps, the result of a real scene with 100 views has a PSNR of 20.9 dB
# without growth, and 20.7 dB with growth. A fit without growth takes .6 of the time of a fit with growth
GROW_ROUNDS = 2


@dataclass(frozen=True)
class Tuning:
    """Constants of the fit, which were chosen on training scenes.

    A run changes a few of these constants. A user can set only the constants that are also options of
    :class:`FitOptions`.
    """

    means_lr: float = 0.1  # Step size of a mean, in units of the Gaussian's size
    scales_lr: float = 0.2  # Step size of a log scale
    quats_lr: float = 0.03  # Step size of a quaternion
    opacities_lr: float = 0.3  # Step size of an opacity's logit
    colors_lr: float = 0.03  # Step size of a colour, sRGB in [0, 1]
    poses_lr: float = 0.1  # Step size at the start, in pixels, of the rotation and the shift of a camera that moves
    # Step sizes of Gaussians at the end of a run, relative to their step sizes at the start. Runs of more than 300
    # steps use a smaller factor
    decay: float = 0.4
    beta1: float = 0.8  # Largest decay of Adam's first moment; gsmerge.method.fit.schedule.first_decay may give less
    beta2: float = 0.9  # Decay of Adam's second moment
    max_mean_shift: float = 2.0  # Largest shift of a mean, in units of the Gaussian's size
    max_scale_change: float = 2.5  # Largest change of a log scale
    max_opacity_change: float = 4.0  # Largest change of an opacity's logit
    # If only one photo shows a Gaussian, its mean and scales may change by this share of the limits above, because one
    # photo determines its colour but not its depth
    single_view_share: float = 0.3
    # Least scale, in pixels of the photo nearest to the Gaussian. Thinner Gaussians look like needles if a viewer
    # enlarges them. 0 sets no limit
    min_scale: float = 0.5
    # A Gaussian is long if three standard deviations exceed `long_share` of the width of the nearest photo. A
    # Gaussian's longest axis may be at most `max_ratio` times its second one, because longer Gaussians look like
    # strokes from other viewpoints. If the fit adds Gaussians after half of its steps, `max_ratio` only holds from then
    # on. Until then there are few Gaussians, which fit better if they may be long
    long_share: float = 0.25
    max_ratio: float = 3.0
    average_share: float = 0.2  # The parameters are averaged over this share of the steps, which are the last ones
    ssim_lambda: float = 0.35  # Share of structural similarity in the loss; the rest is L1
    # Weight in the loss of the L1 error of differences between neighbouring pixels, at the end of a run. At the start
    # of a run the weight is 0, because differences between pixels only help once edges are roughly in their places
    edge_weight: float = 2.4
    # Weight of the mean opacity in the loss (3DGS-MCMC, Kheradmand et al. 2024). This weight fades Gaussians that the
    # photos do not need, because they would hide surfaces in other views
    opacity_reg: float = 0.03
    # Weight of the mean scale in the loss, relative to each Gaussian's size at its start. This weight lets fewer
    # Gaussians overlap, so that a step takes a third less time
    scale_reg: float = 0.01
    outside_every: int = 7  # Every so many steps, a view from outside is drawn, see gsmerge.method.fit.outside
    # Share of the steps before the first view from outside; 1 for no view from outside. Views from outside remove
    # Gaussians in gaps, which at first help other Gaussians to move
    outside_from: float = 0.15
    # Scores compensate the exposures of views only if one exposure differs from the mean exposure by this factor.
    # Smaller differences often come from holes and highlights, not from the camera
    min_gain: float = 1.15

    def scaled(self, factor: float) -> Tuning:
        """Return the constants of the fit with step sizes of Gaussians that are multiplied by ``factor``."""
        names = ("means_lr", "scales_lr", "quats_lr", "opacities_lr", "colors_lr")
        return replace(self, **{name: factor * getattr(self, name) for name in names})


@dataclass(frozen=True)
class FitOptions(Settings):
    """Settings of the fit to the photos."""

    fit: Fit = setting("full", "full: fit the Gaussians to the photos, which takes most of a run's time; none: skip "
        "it.")  # fmt: skip
    fit_steps: int | None = setting(None, "Number of steps of the full fit; each step draws one view.",
        "By default 330, scaled by `effort` and by the numbers of views and Gaussians.", least=1)  # fmt: skip
    photo_scale: float | Literal["auto"] = setting("auto", "Size of the photos in two of every five later steps, "
        "relative to the views; at most the size of the photo files.",
        "`auto`: up to 2 with effort `default` and `best`.", least=1, below=math.inf)  # fmt: skip
    dropout: float | None = setting(None, "Share of the Gaussians that are left out of each step.",
        "By default 0.1 for at most five views and at least 150 steps, 0.05 for at least 600 steps and 30 steps per "
        "view, otherwise 0.", least=0, below=1)  # fmt: skip
    half_res_share: float | None = setting(None, "Share of the steps, at the start of a run, that draw a quarter of "
        "the pixels.", "By default 0.8, with at least 600 steps 0.5, with less than 20 or 30 to 149 steps 1; if "
        "cameras move, photos are larger or steps are fewer than 30, 0.7. Less if there are more Gaussians than 4.4 % "
        "of the pixels.", least=0, most=1)  # fmt: skip
    holdout: float = setting(0.05, "Share of the photos' patches that is held out, to decide whether a fit is "
        "accepted.", above=0, below=1)  # fmt: skip
    min_contribution: float = setting(1 / 255, "Least blending weight of a Gaussian. A fit removes Gaussians that "
        "stay below it at all pixels of the photos that they lie in. 0 keeps all Gaussians, even those that change "
        "no photo by more than rounding, except where others fill gaps between the views in their place.",
        least=0, most=1)  # fmt: skip
    scored: bool = setting(True, "Score held-out patches, and compare whole photos if these hardly gain; "
        "false if the start was made from these patches.", internal=True)  # fmt: skip
    move_cameras: bool = setting(False, "Refine the cameras during the full fit; the plan decides it by `poses`.",
        internal=True)  # fmt: skip
    beyond: bool = setting(False, "Let Gaussians reach beyond all views; the plan decides it by `extent`.",
        internal=True)  # fmt: skip
    fills: bool = setting(False, "Replace Gaussians that no view sees by others; the plan decides it by `budget`.",
        internal=True)  # fmt: skip
    share: float | None = setting(None, "Number of Gaussians in the result per pixel; the plan sets it.",
        "By default 0.044.", internal=True)  # fmt: skip
    grow_steps: int = setting(GROW_STEPS, "Fewest steps of a run that grows; the plan sets it by the number of photos.",
        internal=True)  # fmt: skip
    tuning: Tuning = setting(Tuning(), "Constants.", internal=True)

    @property
    def steps(self) -> int:
        """The number of steps of the full fit."""
        return STEPS if self.fit_steps is None else self.fit_steps

    @property
    def half_res_part(self) -> float:
        """The share of the steps, at the start of a run, that draw only a quarter of the pixels."""
        if self.half_res_share is not None:
            return self.half_res_share
        too_few_steps = 20  # runs with fewer steps are too short to draw whole photos
        can_sample = self.steps >= SAMPLED_STEPS and not self.move_cameras
        # short runs learn more from many samples than from few whole photos
        is_sampled = can_sample and self.steps < GROW_STEPS and self.photo_scale == 1
        if is_sampled or self.steps < too_few_steps:
            return 1.0
        usual = SAMPLED_HALF if can_sample and self.photo_scale in ("auto", 1) else USUAL_HALF
        most = 0.5 if self.steps >= LONG_STEPS else 1.0  # long runs have time for details, which need whole photos
        density = 1.0 if self.share is None or not self.grows else self.share / USUAL_SHARE
        return min(most, usual / math.sqrt(max(density, 1.0)))  # more Gaussians show more details

    @property
    def grows(self) -> bool:
        """True if the fit starts with fewer Gaussians than requested, and adds the others after half of its steps."""
        return self.fit == "full" and self.steps >= self.grow_steps
