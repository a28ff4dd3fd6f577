"""Growth of the Gaussians under optimisation: those with the largest errors are halved."""

from __future__ import annotations

import numpy as np

from gsmerge.fit.fit_state import CARRIED, FitState, state_of
from gsmerge.geometry import lower_median, quat_to_rotmat
from gsmerge.kernels.elementary import exp, log, power
from gsmerge.kernels.gaussians.optimise import LOGIT, QUAT, SIZE
from gsmerge.raster import composite, splat_adjoint, tile_view
from gsmerge.raster.photos import Photos
from gsmerge.runtime.threads import in_turn

OFFSET = 0.7  # of the halves from the middle, in standard deviations; their own shrinks so that the sum keeps its own
FADED = 0.005  # opacity that is as good as none; halves of what has more have at least 1 / 255, which renderers draw
FAINT = 0.02  # opacity of Gaussians that late in a run are on their way to none: without them it takes .9 of the time
DEPTH = 0.8  # of the halves' optical depth: two narrower ones with 0.7 would cover the same, a little more closes gaps


def drop_faint(state: FitState, least: float) -> FitState:
    """Drop the Gaussians with an opacity below ``least``; of a faint scene most stay."""
    opacities = state.splats.opacities
    return state[opacities >= min(least, float(lower_median(opacities)))] if len(opacities) else state


def grow_to(state: FitState, half: Photos, count: int, least: float = FADED) -> FitState:
    """Drop Gaussians with an opacity below ``least``, then split others until there are ``count``.

    There are fewer where no visible one is left to split. ``half``: the half-size photos, whose errors decide which
    Gaussians are split.
    """
    state = drop_faint(state, least)
    if len(state.x) >= count:
        return state
    masses, before = error_masses(state, half), 0
    while before < len(state.x) < count:
        before, (state, masses) = len(state.x), grow(state, masses, count)
    return state


def grow(state: FitState, masses: np.ndarray, count: int) -> tuple[FitState, np.ndarray]:
    """Split the Gaussians with the largest error ``masses [n]`` across their longest axis, until there are ``count``.

    Each is split at most once, so the number at most doubles. Gaussians that no photo shows are not split. Both halves
    inherit momentum, share of the box and least size. First halves keep the rows of their parents, second halves are
    appended. Returns the state and its masses, of which each half has half of its parent's.
    """
    num = min(count - len(state.x), int((masses > 0).sum()))
    if num <= 0:
        return state, masses
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
    masses = masses[source]
    masses[~old] /= 2
    return grown, masses


def error_masses(state: FitState, half: Photos) -> np.ndarray:
    """Sum ``[n]`` blending weight times absolute pixel error, as it counts, of each Gaussian over half-size photos."""

    def one_view(view: int) -> np.ndarray:
        tiled = tile_view(state.splats, **half.camera(view))
        image, _ = composite(tiled, state.view_colors())
        errors = np.abs(image - half.image(view)).mean(-1, keepdims=True)
        if half.importance is not None:
            errors *= half.importance[view][..., None]
        return splat_adjoint(tiled, errors)[:, 0]

    masses = np.zeros(len(state.x))
    for of_view in in_turn(one_view, range(len(half))):
        masses += of_view
    return masses
