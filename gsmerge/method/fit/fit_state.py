"""Parameters of Gaussians under optimisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmerge.method.geometry.transforms import clamp_inside, lies_inside
from gsmerge.method.kernels.elementary import exp, log
from gsmerge.method.kernels.gaussians.optimise import COLOR, COLUMNS, LOGIT, QUAT, SIZE
from gsmerge.method.raster import Splats
from gsmerge.types import SH_C0, Gaussians, Region

# Fields of a state that do not follow from its parameters, so they are copied when rows are taken from it
CARRIED = ("x0", "m", "v", "units", "box_shares", "min_sizes", "origins", "fixed")


@dataclass(eq=False)
class FitState:
    """Parameters under optimisation, and the same values as arrays for the rasterizer."""

    x: np.ndarray  # [n,14] float32: mean, log scale, quaternion, opacity logit, colour
    x0: np.ndarray  # [n,14] parameters at the start, about which the moves are limited
    m: np.ndarray  # [n,14] first moments of Adam
    v: np.ndarray  # [n,14] second moments of Adam
    units: np.ndarray  # [n] size of each Gaussian: geometric mean of its two largest scales at the start
    box_shares: np.ndarray  # [n] share of the box about the start within which means and scales may move
    min_sizes: np.ndarray  # [n] least log scale of each Gaussian
    origins: np.ndarray  # [n] for each Gaussian, the row of the Gaussian at the start of the fit from which it comes
    fixed: np.ndarray  # [n] bool, Gaussians that stay unchanged
    splats: Splats  # Means, quaternions, scales and opacities as the rasterizer takes them
    colors: np.ndarray  # [n,3] base colours, sRGB

    def __getitem__(self, rows: np.ndarray) -> FitState:
        """Return the state of some Gaussians, which ``rows`` selects as a mask or by number."""
        state = state_of(self.x[rows], self.splats.shN[rows])
        for name in CARRIED:
            setattr(state, name, getattr(self, name)[rows])
        return state

    def keep_inside(self, region: Region) -> None:
        """Move the centres of Gaussians outside of a region to its border, in place, except fixed Gaussians."""
        rows = np.flatnonzero(~lies_inside(region, self.x[:, :SIZE]) & ~self.fixed)
        self.x[rows, :SIZE] = self.splats.means[rows] = clamp_inside(region, self.x[rows, :SIZE])

    def update_harmonics(self) -> None:
        """Write the base colours to ``splats.sh0``, if there are higher harmonics; otherwise nothing reads ``sh0``."""
        if self.splats.shN.shape[1] > 0:
            np.divide(self.colors[:, None] - np.float32(0.5), np.float32(SH_C0), out=self.splats.sh0)

    def view_colors(self) -> np.ndarray | None:
        """Return the colours to draw, or None if colours depend on the direction of view.

        If colours depend on the direction, base colours are written to ``splats.sh0``, and the rasterizer computes
        colours from ``splats.sh0`` and ``splats.shN``.
        """
        self.update_harmonics()
        return self.colors if self.splats.shN.shape[1] == 0 else None


def start_state(gaussians: Gaussians) -> FitState:
    """Return the state at the start of a fit: the parameters of the Gaussians, and moments of zero."""
    x = np.empty((len(gaussians), COLUMNS), np.float32)
    opacities = gaussians.opacities.astype(np.float64).clip(0.004, 0.999)  # beyond, a step hardly changes opacities
    x[:, :3] = gaussians.means
    x[:, SIZE:QUAT] = log(gaussians.scales.clip(1e-9))
    x[:, QUAT:LOGIT] = gaussians.quats
    x[:, LOGIT] = log(opacities / (1 - opacities))
    x[:, COLOR:] = 0.5 + SH_C0 * gaussians.sh0[:, 0]
    return state_of(x, gaussians.shN)


def state_of(x: np.ndarray, shN: np.ndarray) -> FitState:
    """Return a new state with parameters ``x [n,14]``, which are not copied, and harmonics ``shN [n,k-1,3]``."""
    log_scales = np.sort(x[:, SIZE:QUAT], 1)
    colors = np.ascontiguousarray(x[:, COLOR:])
    splats = Splats(
        means=np.ascontiguousarray(x[:, :3]),
        quats=np.ascontiguousarray(x[:, QUAT:LOGIT]),
        scales=exp(x[:, SIZE:QUAT]),
        opacities=1 / (1 + exp(-x[:, LOGIT])),
        sh0=(colors[:, None] - np.float32(0.5)) / np.float32(SH_C0),
        shN=shN,
        origin=np.zeros(3),
    )
    return FitState(
        x=x,
        x0=x.copy(),
        m=np.zeros_like(x),
        v=np.zeros_like(x),
        units=exp((log_scales[:, 1] + log_scales[:, 2]) / 2),
        box_shares=np.ones(len(x), np.float32),
        min_sizes=np.full(len(x), -np.inf, np.float32),
        origins=np.arange(len(x)),
        fixed=np.zeros(len(x), bool),
        splats=splats,
        colors=colors,
    )


def gaussians_of(x: np.ndarray, shN: np.ndarray) -> Gaussians:
    """Convert parameters ``x [n,14]`` and higher harmonics ``shN [n,k-1,3]`` to Gaussians."""
    return Gaussians(
        means=x[:, :3].copy(),
        quats=x[:, QUAT:LOGIT].copy(),
        scales=exp(x[:, SIZE:QUAT]),
        opacities=1 / (1 + exp(-x[:, LOGIT])),
        sh0=((x[:, COLOR:] - 0.5) / SH_C0)[:, None],
        shN=shN.copy(),
    )
