"""Spend more Gaussians where the photos are still shown worst, on a device: :mod:`gsmerge.stages.fit.grow`."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsmerge.gpu.adam import FitState, state_of
from gsmerge.gpu.holdout import state_colors, state_shape
from gsmerge.gpu.raster import draw_and_transpose
from gsmerge.gpu.scene import DevicePhotos
from gsmerge.kernels.gaussians.optimise import LOGIT, QUAT, SIZE
from gsmerge.networks.residuals import quat_to_rotmat
from gsmerge.stages.fit.grow import DEPTH, OFFSET


def error_masses(state: FitState, photos: DevicePhotos) -> Tensor:
    """``[n]`` sum over all photos of every Gaussian's blending weight times the absolute error of the pixel."""
    masses = torch.zeros(len(state), dtype=torch.float64, device=state.x.device)
    for view in range(len(photos)):
        image, transpose = draw_and_transpose(state_shape(state), state_colors(state, photos, view), photos, view)
        error = (image - photos.images[view]).abs().mean(-1, keepdim=True)
        masses += transpose(error.expand_as(image))[:, 0]
    return masses


def grow_to(state: FitState, photos: DevicePhotos, count: int) -> FitState:
    """:func:`grow` again and again, until there are ``count`` or nothing that the photos show is left to halve."""
    before = 0
    while before < len(state) < count:
        before, state = len(state), grow(state, photos, count)
    return state


def grow(state: FitState, photos: DevicePhotos, count: int) -> FitState:
    """Halve the Gaussians with the largest error masses across their longest axis, until there are ``count``."""
    masses = error_masses(state, photos)
    num = min(count - len(state), int((masses > 0).sum()))
    if num <= 0:
        return state
    picked = torch.sort(-masses, stable=True).indices[:num].sort().values
    parents, rows = state.x[picked], torch.arange(num, device=picked.device)
    longest = parents[:, SIZE:QUAT].argmax(1)
    reach = OFFSET * parents[rows, SIZE + longest].exp()
    shift = quat_to_rotmat(parents[:, QUAT:LOGIT])[rows, :, longest] * reach[:, None]
    halves = parents.clone()
    halves[rows, SIZE + longest] += 0.5 * math.log(1 - OFFSET**2)
    clear = (-halves[:, LOGIT].double()).sigmoid()  # 1 - opacity
    halves[:, LOGIT] = (1 / clear**DEPTH - 1).log().float()
    x = torch.cat([state.x, halves])
    x[picked] = halves
    x[picked, :3] -= shift
    x[len(state) :, :3] += shift
    source = torch.cat([torch.arange(len(state), device=picked.device), picked])
    grown = state_of(x, state.shN[source])
    old = torch.ones(len(state), dtype=torch.bool, device=picked.device)
    old[picked] = False
    rows = torch.nonzero(old)[:, 0]
    grown.x0[rows], grown.units[rows] = state.x0[rows], state.units[rows]
    for name in ("m", "v", "box_shares", "min_sizes"):
        setattr(grown, name, getattr(state, name)[source])
    return grown
