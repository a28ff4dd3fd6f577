"""Add Gaussians during the optimisation, by splitting the Gaussians with the largest errors."""

from __future__ import annotations

import numpy as np

from gsmerge.fit.fit_state import CARRIED, FitState, state_of
from gsmerge.geometry.transforms import lower_median, quat_to_rotmat
from gsmerge.kernels.elementary import exp, log, power
from gsmerge.kernels.gaussians.optimise import LOGIT, QUAT, SIZE
from gsmerge.raster import composite, splat_adjoint, tile_view
from gsmerge.raster.photos import Photos
from gsmerge.runtime.threads import in_turn

# Distance of a half from the middle of its parent, in standard deviations of the parent. The standard deviations of
# halves shrink, so that the pair together has the standard deviation of the parent
OFFSET = 0.7
FADED = 0.005  # opacity that counts as none; halves of more opaque Gaussians have 1 / 255 or more, so they are drawn
FAINT = 0.02  # opacity of Gaussians that late in a run will fade away; without them the run takes .9 of the time
# Most Gaussians after a growth, as a multiple of those that are left when it begins. Where many views show the same
# surfaces, most Gaussians of the start are hidden, and the usual share of all pixels is far more than the surfaces can
# use: further halves are smaller than the details of the photos, and most of them fade. Real scenes of 60 and 84 views
# gain .1 to .2 dB over growth to the share, in .7 to .8 of the time; a fourfold growth costs a made room .06 dB. With
# up to a dozen views growth is about twofold
MOST_GROWTH = 8


def drop_faint(state: FitState, least: float) -> FitState:
    """Drop the Gaussians with an opacity below ``least``, or below the median if that is less, as in a faint scene."""
    opacities = state.splats.opacities
    return state[opacities >= min(least, float(lower_median(opacities)))] if len(opacities) else state


def grow_to(
    state: FitState, half: Photos, count: int, least: float = FADED, most_growth: int | None = None
) -> FitState:
    """Drop Gaussians with an opacity below ``least``, then split others until there are ``count``.

    There are fewer if no visible Gaussian is left to split, and at most ``most_growth`` times as many as remained
    (None: any number). The errors of the half-size photos ``half`` decide which Gaussians are split.
    """
    state = drop_faint(state, least)
    count = count if most_growth is None else min(count, most_growth * len(state.x))
    if len(state.x) >= count:
        return state
    masses, before = error_masses(state, half), 0
    while before < len(state.x) < count:
        before, (state, masses) = len(state.x), grow(state, masses, count)
    return state


def grow(state: FitState, masses: np.ndarray, count: int) -> tuple[FitState, np.ndarray]:
    """Split the Gaussians with the largest error ``masses [n]`` across their longest axis, until there are ``count``.

    Each Gaussian is split at most once, so the number at most doubles. Gaussians that no photo shows are not split.
    Both halves inherit momentum, share of the box and least size. First halves keep the rows of their parents, second
    halves are appended. Returns the state and its masses; a half has half of its parent's mass.
    """
    num = min(count - len(state.x), int((masses > 0).sum()))
    if num <= 0:
        return state, masses
    worst = np.sort(np.argsort(-masses, kind="stable")[:num])
    first_halves, second_halves = split_parameters(state.x[worst])
    x = np.concatenate([state.x, second_halves])
    x[worst] = first_halves
    parents = np.concatenate([np.arange(len(state.x)), worst])
    grown = state_of(x, state.splats.shN[parents])
    is_half = np.zeros(len(x), bool)
    is_half[worst] = is_half[len(state.x) :] = True
    unsplit = ~is_half[: len(state.x)]
    # halves start anew: the centre of their box and their unit of size follow from their own parameters
    grown.x0[~is_half], grown.units[~is_half] = state.x0[unsplit], state.units[unsplit]
    for name in set(CARRIED) - {"x0", "units"}:
        getattr(grown, name)[:] = getattr(state, name)[parents]
    masses = masses[parents]
    masses[is_half] /= 2
    return grown, masses


def split_parameters(parents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split parameters ``[m,14]`` across the longest axis; return the parameters of the first and the second halves."""
    rows, longest = np.arange(len(parents)), parents[:, SIZE:QUAT].argmax(1)
    reach = OFFSET * exp(parents[rows, SIZE + longest])
    rotations = quat_to_rotmat(parents[:, QUAT:LOGIT])
    shift = rotations[rows, :, longest] * reach[:, None]
    halves = parents.copy()
    halves[rows, SIZE + longest] += 0.5 * log(1 - OFFSET**2)
    halves[:, LOGIT] = fade_halves(halves[:, LOGIT])
    first_halves, second_halves = halves, halves.copy()
    first_halves[:, :SIZE] -= shift
    second_halves[:, :SIZE] += shift
    return first_halves, second_halves


def fade_halves(logits: np.ndarray) -> np.ndarray:
    """Return the opacity logits ``[m]`` of the halves of Gaussians with opacity ``logits [m]``."""
    transmittances = 1 / (1 + exp(logits.astype(np.float64)))  # 1 - opacity
    # Optical depth of a half, as a share of the parent's depth. Halves are narrower than the parent, so two halves of
    # 0.7 cover as much as the parent; a little more closes gaps
    depth_share = 0.8
    return np.asarray(log(1 / power(transmittances, depth_share) - 1))


def error_masses(state: FitState, half: Photos) -> np.ndarray:
    """Sum each Gaussian's blending weight times the absolute pixel error over half-size photos: ``[n]``.

    Errors are multiplied by the importance of their pixels.
    """

    def one_view(view: int) -> np.ndarray:
        tiled = tile_view(state.splats, **half.camera(view))
        image, _ = composite(tiled, state.view_colors())
        errors = np.abs(image - half.image(view)).mean(-1, keepdims=True)
        if half.importance is not None:
            errors *= half.importance[view][..., None]
        return splat_adjoint(tiled, errors)[:, 0]

    masses = np.zeros(len(state.x))
    for view_masses in in_turn(one_view, range(len(half))):
        masses += view_masses
    return masses
