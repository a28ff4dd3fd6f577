"""Parameters of Gaussians under optimisation, and their growth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gsmerge.geometry import lower_median, quat_to_rotmat
from gsmerge.kernels.elementary import exp, log, power
from gsmerge.kernels.gaussians.optimise import COLOR, COLUMNS, LOGIT, QUAT, SIZE
from gsmerge.raster import Splats
from gsmerge.types import SH_C0, Gaussians

OFFSET = 0.7  # of the halves from the middle, in standard deviations; their own shrinks so that the sum keeps its own
FADED = 0.005  # opacity that is as good as none; halves of what has more have at least 1 / 255, which renderers draw
DEPTH = 0.8  # of the halves' optical depth: two narrower ones with 0.7 would cover the same, a little more closes gaps
# What rows of a state carry along, beside what follows from their parameters
CARRIED = ("x0", "m", "v", "units", "box_shares", "min_sizes", "origins", "fixed")


@dataclass(eq=False)
class State:
    """Parameters under optimisation, and the same values as arrays for the rasterizer."""

    x: np.ndarray  # [n,14] float32: mean, log scale, quaternion, opacity logit, colour
    x0: np.ndarray  # Values at the start
    m: np.ndarray  # First moment
    v: np.ndarray  # Second moment
    units: np.ndarray  # [n] size: geometric mean of the two largest scales at the start
    box_shares: np.ndarray  # [n] share of the box about the start for means and scales
    min_sizes: np.ndarray  # [n] least log scale of each Gaussian
    origins: np.ndarray  # [n] row of the start that each comes from
    fixed: np.ndarray  # [n] bool, whether it stays as it is
    splats: Splats  # Means, quaternions, scales and opacities as the rasterizer takes them
    colors: np.ndarray  # [n,3] base colours

    def __getitem__(self, rows: np.ndarray) -> State:
        """Return the state of some Gaussians, by mask or by row."""
        kept = state_of(self.x[rows], self.splats.shN[rows])
        for name in CARRIED:
            setattr(kept, name, getattr(self, name)[rows])
        return kept

    def view_colors(self) -> np.ndarray | None:
        """Return the colours for the rasterizer; None if it evaluates the harmonics, which are updated first."""
        if self.splats.shN.shape[1] == 0:
            return self.colors
        np.divide(self.colors[:, None] - np.float32(0.5), np.float32(SH_C0), out=self.splats.sh0)
        return None


def start_state(gaussians: Gaussians) -> State:
    """Start the optimiser's state from Gaussians: their parameters, zero moments."""
    x = np.empty((len(gaussians), COLUMNS), np.float32)
    opacities = gaussians.opacities.astype(np.float64).clip(0.004, 0.999)
    x[:, :3] = gaussians.means
    x[:, SIZE:QUAT] = log(gaussians.scales.clip(1e-9))
    x[:, QUAT:LOGIT] = gaussians.quats
    x[:, LOGIT] = log(opacities / (1 - opacities))
    x[:, COLOR:] = 0.5 + SH_C0 * gaussians.sh0[:, 0]
    return state_of(x, gaussians.shN)


def state_of(x: np.ndarray, shN: np.ndarray) -> State:
    """Start the optimiser's state at parameters ``x [n,14]`` and higher harmonics ``[n,k-1,3]``."""
    sizes = np.sort(x[:, SIZE:QUAT], 1)
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
    units = exp((sizes[:, 1] + sizes[:, 2]) / 2)
    shares, least = np.ones_like(units), np.full_like(units, -np.inf)
    zero, rows, fixed = np.zeros_like(x), np.arange(len(x)), np.zeros(len(x), bool)
    return State(x, x.copy(), zero, zero.copy(), units, shares, least, rows, fixed, splats, colors)


def gaussians_of(x: np.ndarray, shN: np.ndarray) -> Gaussians:
    """Convert parameters ``x [n,14]`` and higher harmonics ``[n,k-1,3]`` to Gaussians."""
    return Gaussians(
        means=x[:, :3].copy(),
        quats=x[:, QUAT:LOGIT].copy(),
        scales=exp(x[:, SIZE:QUAT]),
        opacities=1 / (1 + exp(-x[:, LOGIT])),
        sh0=((x[:, COLOR:] - 0.5) / SH_C0)[:, None],
        shN=shN.copy(),
    )


def grow_to(state: State, error_masses: Callable[[State], np.ndarray], count: int) -> State:
    """Drop faded Gaussians, then halve others until there are ``count``, or no visible one is left to halve."""
    before, opacities = 0, state.splats.opacities
    if len(opacities):
        state = state[opacities >= min(FADED, float(lower_median(opacities)))]  # of a faint scene most stay
    while before < len(state.x) < count:
        before, state = len(state.x), grow(state, error_masses(state), count)
    return state


def grow(state: State, masses: np.ndarray, count: int) -> State:
    """Halve the Gaussians with the largest error ``masses [n]`` across their longest axis, until there are ``count``.

    Each is halved at most once, so the number at most doubles, and what no photo shows is left
    alone. The halves start with their parent's momentum, share of the box and least size; the old
    ones come first and in order, the second halves after them.
    """
    num = min(count - len(state.x), int((masses > 0).sum()))
    if num <= 0:
        return state
    picked = np.sort(np.argsort(-masses, kind="stable")[:num])
    parents, rows = state.x[picked], np.arange(num)
    longest = parents[:, SIZE:QUAT].argmax(1)
    reach = OFFSET * exp(parents[rows, SIZE + longest])
    rotations = quat_to_rotmat(parents[:, QUAT:LOGIT])
    shift = rotations[rows, :, longest] * reach[:, None]
    halves = parents.copy()
    halves[rows, SIZE + longest] += 0.5 * log(1 - OFFSET**2)
    clear = 1 / (1 + exp(halves[:, LOGIT].astype(np.float64)))  # 1 - opacity
    halves[:, LOGIT] = log(1 / power(clear, DEPTH) - 1)
    x = np.concatenate([state.x, halves])
    x[picked] = halves
    x[picked, :3] -= shift
    x[len(state.x) :, :3] += shift
    source = np.concatenate([np.arange(len(state.x)), picked])
    grown = state_of(x, state.splats.shN[source])
    old = np.ones(len(x), bool)
    old[picked] = old[len(state.x) :] = False
    grown.x0[old], grown.units[old] = state.x0[old[: len(state.x)]], state.units[old[: len(state.x)]]
    for name in set(CARRIED) - {"x0", "units"}:
        getattr(grown, name)[:] = getattr(state, name)[source]
    return grown
