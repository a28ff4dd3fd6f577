"""The optimiser's view of some Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmerge.kernels.gaussians.optimise import COLOR, COLUMNS, LOGIT, QUAT, SIZE
from gsmerge.render import Splats
from gsmerge.types import SH_C0, Gaussians


@dataclass(eq=False)
class State:
    """Parameters under optimisation, and the arrays that they mean to the rasterizer.

    Args:
        x: ``[n,14]`` float32: mean, log scale, quaternion, opacity logit, colour.
        x0: Where each began.
        m: First moment.
        v: Second moment.
        units: ``[n]`` size of each Gaussian: geometric mean of its two largest scales when it began.
        box_shares: ``[n]`` share of the box about the start that each Gaussian's mean and scales may use.
        min_sizes: ``[n]`` least log scale of each Gaussian.
        splats: Means, quaternions, scales and opacities as the rasterizer takes them.
        colors: ``[n,3]`` base colours.
    """

    x: np.ndarray
    x0: np.ndarray
    m: np.ndarray
    v: np.ndarray
    units: np.ndarray
    box_shares: np.ndarray
    min_sizes: np.ndarray
    splats: Splats
    colors: np.ndarray

    def view_colors(self) -> np.ndarray | None:
        """Colours for the rasterizer: as they are, or None: from the harmonics, which are brought up to date."""
        if self.splats.shN.shape[1] == 0:
            return self.colors
        np.divide(self.colors[:, None] - np.float32(0.5), np.float32(SH_C0), out=self.splats.sh0)
        return None


def start_state(gaussians: Gaussians) -> State:
    """A fresh state at some Gaussians."""
    x = np.empty((len(gaussians), COLUMNS), np.float32)
    opacities = gaussians.opacities.astype(np.float64).clip(0.004, 0.999)
    x[:, :3] = gaussians.means
    x[:, SIZE:QUAT] = np.log(gaussians.scales.clip(1e-9))
    x[:, QUAT:LOGIT] = gaussians.quats
    x[:, LOGIT] = np.log(opacities / (1 - opacities))
    x[:, COLOR:] = 0.5 + SH_C0 * gaussians.sh0[:, 0]
    return state_of(x, gaussians.shN)


def state_of(x: np.ndarray, shN: np.ndarray) -> State:
    """A fresh state at parameters ``[n,14]`` and higher harmonics ``[n,k-1,3]``."""
    sizes = np.sort(x[:, SIZE:QUAT], 1)
    colors = np.ascontiguousarray(x[:, COLOR:])
    splats = Splats(
        means=np.ascontiguousarray(x[:, :3]),
        quats=np.ascontiguousarray(x[:, QUAT:LOGIT]),
        scales=np.exp(x[:, SIZE:QUAT]),
        opacities=1 / (1 + np.exp(-x[:, LOGIT])),
        sh0=(colors[:, None] - np.float32(0.5)) / np.float32(SH_C0),
        shN=shN,
        origin=np.zeros(3),
    )
    units = np.exp((sizes[:, 1] + sizes[:, 2]) / 2)
    shares, least = np.ones_like(units), np.full_like(units, -np.inf)
    return State(x, x.copy(), np.zeros_like(x), np.zeros_like(x), units, shares, least, splats, colors)


def gaussians_of(x: np.ndarray, shN: np.ndarray) -> Gaussians:
    """The Gaussians that parameters ``[n,14]`` stand for."""
    return Gaussians(
        means=x[:, :3].copy(),
        quats=x[:, QUAT:LOGIT].copy(),
        scales=np.exp(x[:, SIZE:QUAT]),
        opacities=1 / (1 + np.exp(-x[:, LOGIT])),
        sh0=((x[:, COLOR:] - 0.5) / SH_C0)[:, None],
        shN=shN.copy(),
    )
