"""Spend more Gaussians where the photos are still shown worst."""

from __future__ import annotations

import numpy as np

from gsmerge.geometry import quat_to_rotmat
from gsmerge.kernels.gaussians.optimise import LOGIT, QUAT, SIZE
from gsmerge.render import composite, plan_view, splat_adjoint
from gsmerge.render.photos import Photos
from gsmerge.runtime.threads import in_turn
from gsmerge.stages.fit.state import State, state_of

OFFSET = 0.7  # of the halves from the middle, in standard deviations; their own shrinks so that the sum keeps its own
DEPTH = 0.8  # of the halves' optical depth: two narrower ones with 0.7 would cover the same, a little more closes gaps


def error_masses(state: State, photos: Photos) -> np.ndarray:
    """``[n]`` sum over all photos of every Gaussian's blending weight times the absolute error of the pixel."""

    def one_view(view: int) -> np.ndarray:
        plan = plan_view(state.splats, **photos.camera(view))
        image, _ = composite(plan, state.view_colors())
        return splat_adjoint(plan, np.abs(image - photos.image(view)).mean(-1, keepdims=True))[:, 0]

    masses = np.zeros(len(state.x))
    for of_view in in_turn(one_view, range(len(photos))):
        masses += of_view
    return masses


def grow_to(state: State, photos: Photos, count: int) -> State:
    """:func:`grow` again and again, until there are ``count`` or nothing that the photos show is left to halve."""
    before = 0
    while before < len(state.x) < count:
        before, state = len(state.x), grow(state, photos, count)
    return state


def grow(state: State, photos: Photos, count: int) -> State:
    """Halve the Gaussians with the largest error masses across their longest axis, until there are ``count``.

    Each is halved at most once, so the number at most doubles, and what no photo shows is left alone. The halves
    start with their parent's momentum, share of the box and least size; the old ones come first and in order, the
    second halves after them.

    Args:
        state: n Gaussians under optimisation.
        photos: What they are to look like.
        count: Wanted number, not below n.
    """
    masses = error_masses(state, photos)
    num = min(count - len(state.x), int((masses > 0).sum()))
    if num <= 0:
        return state
    picked = np.sort(np.argsort(-masses, kind="stable")[:num])
    parents, rows = state.x[picked], np.arange(num)
    longest = parents[:, SIZE:QUAT].argmax(1)
    reach = OFFSET * np.exp(parents[rows, SIZE + longest])
    rotations = quat_to_rotmat(parents[:, QUAT:LOGIT])
    shift = rotations[rows, :, longest] * reach[:, None]
    halves = parents.copy()
    halves[rows, SIZE + longest] += 0.5 * np.log(1 - OFFSET**2)
    clear = 1 / (1 + np.exp(halves[:, LOGIT].astype(np.float64)))  # 1 - opacity
    halves[:, LOGIT] = np.log(1 / clear**DEPTH - 1)
    x = np.concatenate([state.x, halves])
    x[picked] = halves
    x[picked, :3] -= shift
    x[len(state.x) :, :3] += shift
    source = np.concatenate([np.arange(len(state.x)), picked])
    grown = state_of(x, state.splats.shN[source])
    old = np.ones(len(x), bool)
    old[picked] = old[len(state.x) :] = False
    grown.x0[old], grown.units[old] = state.x0[old[: len(state.x)]], state.units[old[: len(state.x)]]
    for name in ("m", "v", "box_shares", "min_sizes"):
        getattr(grown, name)[:] = getattr(state, name)[source]
    return grown
