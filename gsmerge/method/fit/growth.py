"""Add Gaussians during the optimisation, by splitting the Gaussians with the largest errors."""

from __future__ import annotations

import numpy as np

from gsmerge.method.fit.fit_state import CARRIED, FitState, state_of
from gsmerge.method.geometry.transforms import lower_median, quat_to_rotmat
from gsmerge.method.kernels.elementary import exp, log, power
from gsmerge.method.kernels.gaussians.optimise import LOGIT, QUAT, SIZE
from gsmerge.method.raster import composite, splat_adjoint, tile_view
from gsmerge.method.raster.photos import Photos
from gsmerge.runtime.threads import in_turn

# Distance of a half from the centre of its parent, in standard deviations of the parent. The halves are narrower than
# the parent, so that both together have the parent's standard deviation
OFFSET = 0.7
FADED = 0.005  # fainter Gaussians are dropped, because their halves would be fainter than 1 / 255 and not be drawn
FAINT = 0.02  # late in a run, fainter Gaussians only fade away; without them the run takes .9 of the time
# Largest factor by which a growth may raise the number of Gaussians. The usual number of Gaussians is a share of all
# pixels, which is more than surfaces need if many views show them. Gaussians that are split too often become smaller
# than the details of the photos, and fade. Compared with growth without a limit, MOST_GROWTH gains .1 to .2 dB in real
# scenes of 60 and 84 views, and takes .7 to .8 of the time. A rendered room loses .06 dB if MOST_GROWTH is 4 instead of
# 8. Scenes of up to a dozen views never grow by MOST_GROWTH
MOST_GROWTH = 8


def drop_faint(state: FitState, least: float) -> FitState:
    """Drop the Gaussians with an opacity below ``least``, but at most the fainter half of all Gaussians."""
    opacities = state.splats.opacities
    return state[opacities >= min(least, float(lower_median(opacities)))] if len(opacities) else state


def grow_to(
    state: FitState, half: Photos, count: int, least: float = FADED, most_growth: int | None = None
) -> FitState:
    """Drop Gaussians with an opacity below ``least``, then split others until there are ``count``.

    The number of Gaussians after the drop grows at most by the factor ``most_growth``; None sets no limit. The result
    also has fewer Gaussians than ``count`` if no photo shows a Gaussian that could be split. The errors of the
    half-size photos ``half`` decide which Gaussians are split.
    """
    state = drop_faint(state, least)
    count = count if most_growth is None else min(count, most_growth * len(state.x))
    if len(state.x) >= count:
        return state
    masses = error_masses(state, half)
    before = 0
    while before < len(state.x) < count:
        before = len(state.x)
        state, masses = grow(state, masses, count)
    return state


def grow(state: FitState, masses: np.ndarray, count: int) -> tuple[FitState, np.ndarray]:
    """Split the Gaussians with the largest error ``masses [n]`` across their longest axis, until there are ``count``.

    Each Gaussian is split at most once, so ``count`` may not be reached, and the number at most doubles. Gaussians that
    no photo shows are not split. Both halves inherit the momentum, the share of the box and the least size of their
    parent. First halves take the rows of their parents, and second halves are appended. Returns the new state and its
    masses; the mass of a half is half of its parent's mass.
    """
    num = min(count - len(state.x), int((masses > 0).sum()))
    if num <= 0:
        return state, masses
    worst = np.sort(np.argsort(-masses, kind="stable")[:num])
    first_halves = state.x[worst]
    rows = np.arange(num)
    longest = first_halves[:, SIZE:QUAT].argmax(1)
    distances = OFFSET * exp(first_halves[rows, SIZE + longest])
    shift = quat_to_rotmat(first_halves[:, QUAT:LOGIT])[rows, :, longest] * distances[:, None]
    first_halves[rows, SIZE + longest] += 0.5 * log(1 - OFFSET**2)  # so both halves together are as long as the parent
    first_halves[:, LOGIT] = fade_halves(first_halves[:, LOGIT])
    second_halves = first_halves.copy()
    first_halves[:, :SIZE] -= shift
    second_halves[:, :SIZE] += shift
    x = np.concatenate([state.x, second_halves])
    x[worst] = first_halves
    parents = np.concatenate([np.arange(len(state.x)), worst])
    grown = state_of(x, state.splats.shN[parents])
    is_half = np.zeros(len(x), bool)
    is_half[worst] = is_half[len(state.x) :] = True
    unsplit = ~is_half[: len(state.x)]
    # the centre of a half's box and the unit of its size follow from the half's parameters, not from the parent's
    grown.x0[~is_half], grown.units[~is_half] = state.x0[unsplit], state.units[unsplit]
    for name in set(CARRIED) - {"x0", "units"}:
        getattr(grown, name)[:] = getattr(state, name)[parents]
    masses = masses[parents]
    masses[is_half] /= 2
    return grown, masses


def fade_halves(logits: np.ndarray) -> np.ndarray:
    """Return the opacity logits ``[m]`` for halves of Gaussians with the opacity ``logits [m]``."""
    transmittances = 1 / (1 + exp(logits.astype(np.float64)))  # 1 - opacity
    # Optical depth of a half, as a share of the parent's. Halves are narrower than the parent. With a share of 0.7,
    # both halves together would cover as much as the parent. With 0.8 they cover a little more, which closes gaps
    # between the halves
    depth_share = 0.8
    return np.asarray(log(1 / power(transmittances, depth_share) - 1))


def error_masses(state: FitState, half: Photos) -> np.ndarray:
    """Return the error mass ``[n]`` of each Gaussian: blending weight times absolute error, summed over all pixels.

    The half-size photos ``half`` give the pixels. Errors are multiplied by the importance of their pixels.
    """

    def view_masses(view: int) -> np.ndarray:
        """Return the error mass ``[n]`` of each Gaussian in one view."""
        tiled = tile_view(state.splats, **half.camera(view))
        image, _ = composite(tiled, state.view_colors())
        errors = np.abs(image - half.image(view)).mean(-1, keepdims=True)
        if half.importance is not None:
            errors *= half.importance[view][..., None]
        return splat_adjoint(tiled, errors)[:, 0]

    masses = np.zeros(len(state.x))
    for added_masses in in_turn(view_masses, range(len(half))):
        masses += added_masses
    return masses
