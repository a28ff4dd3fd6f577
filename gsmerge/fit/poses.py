"""Poses of cameras under optimisation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmerge.fit.schedule import first_decay
from gsmerge.geometry.transforms import motion_matrices
from gsmerge.kernels.elementary import power
from gsmerge.kernels.matrices import matmul
from gsmerge.raster.photos import Photos
from gsmerge.settings.fit import Tuning


@dataclass(eq=False)
class PoseState:
    """Motions of the cameras under optimisation. Their mean stays zero, so that the scene does not drift."""

    start: np.ndarray  # [v,4,4] viewmats before the fit
    viewmats: np.ndarray  # [v,4,4] float64; steps update it in place, and all sizes of the photos share it
    # [v,6] motion of each camera, see transforms.motion_vectors. The centre of its rotation is the middle of the
    # scene, where rotations and shifts of a camera look different
    x: np.ndarray
    m: np.ndarray  # First moment
    v: np.ndarray  # Second moment
    counts: np.ndarray  # [v] steps that each camera has taken
    pixel: float  # Angle of a pixel, radians; also its size at the scene's depth

    def step(self, view: int, gradient: np.ndarray, rates: Tuning, progress: float) -> None:
        """Take one Adam step (Nadam) of a view along the gradient ``[4,4]`` of its viewmat.

        The size of steps falls to zero at the end of the fit.
        """
        local = matmul(self.viewmats[view, :3, :3].T, gradient[:3])
        (_, xy, xz), (yx, _, yz), (zx, zy, _) = local[:, :3]
        slope = np.array([zy - yz, xz - zx, yx - xy, *local[:, 3]])  # of rotation and shift
        self.counts[view] += 1
        betas = first_decay(rates, self.counts[view]), rates.beta2
        for moments, beta, sample in zip((self.m, self.v), betas, (slope, slope**2), strict=True):
            moments[view] += (1 - beta) * (sample - moments[view])
        next_m = betas[0] * self.m[view] + (1 - betas[0]) * slope  # Nesterov's look-ahead
        bias_m, bias_v = power(betas, self.counts[view] + np.array([1, 0]))
        m_hat, v_hat = next_m / (1 - bias_m), self.v[view] / (1 - bias_v)
        eps = 1e-15  # added to the denominator of Adam's step
        self.x[view] -= rates.poses_lr * self.pixel * (1 - progress) * m_hat / (np.sqrt(v_hat) + eps)
        self.x -= self.x.mean(0)
        self.viewmats[:] = matmul(self.start, motion_matrices(self.x))


def start_poses(photos: tuple[Photos, ...]) -> tuple[PoseState, tuple[Photos, ...]]:
    """Return motions of zero for the photos' cameras, and the photos with viewmats that the motions update."""
    start = photos[0].viewmats.astype(np.float64)
    zero, shared = np.zeros((len(start), 6)), start.copy()
    pixel = 1 / float(photos[0].Ks[:, [0, 1], [0, 1]].mean())
    state = PoseState(start, shared, zero, zero.copy(), zero.copy(), np.zeros(len(start), np.int64), pixel)
    return state, tuple(replace(level, viewmats=shared) for level in photos)
