"""Motions of the cameras under optimisation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmerge.geometry import motion_matrices
from gsmerge.kernels.elementary import power
from gsmerge.kernels.matrices import matmul
from gsmerge.raster.photos import Photos
from gsmerge.settings.fit import Tuning

EPS = 1e-15  # of Adam


@dataclass(eq=False)
class PoseState:
    """Motions of the cameras under optimisation; their mean stays zero, so that the scene does not drift."""

    start: np.ndarray  # [v,4,4] viewmats before the fit
    viewmats: np.ndarray  # [v,4,4] float64, updated by steps, shared with all photos
    # [v,6] motion of each, see gsmerge.geometry.motion_vectors: about the scene's middle, where
    # turns and shifts of a camera show differently
    x: np.ndarray
    m: np.ndarray  # First moment
    v: np.ndarray  # Second moment
    counts: np.ndarray  # [v] steps of each
    pixel: float  # Angle of a pixel, radians; also its size at the scene's depth

    def step(self, view: int, gradient: np.ndarray, rates: Tuning, progress: float) -> None:
        """Take one Adam step of a view by the gradient ``[4,4]`` of its viewmat; step sizes fall to zero at the end."""
        turns = matmul(self.viewmats[view, :3, :3].T, gradient[:3])
        (_, ab, ac), (ba, _, bc), (ca, cb, _) = turns[:, :3]
        slope = np.array([cb - bc, ac - ca, ba - ab, *turns[:, 3]])
        self.counts[view] += 1
        for moment, beta, value in ((self.m, rates.beta1, slope), (self.v, rates.beta2, slope**2)):
            moment[view] += (1 - beta) * (value - moment[view])
        first_left, second_left = power([rates.beta1, rates.beta2], self.counts[view])
        first, second = self.m[view] / (1 - first_left), self.v[view] / (1 - second_left)
        self.x[view] -= rates.poses_lr * self.pixel * (1 - progress) * first / (np.sqrt(second) + EPS)
        self.x -= self.x.mean(0)
        self.viewmats[:] = matmul(self.start, motion_matrices(self.x))


def start_poses(photos: tuple[Photos, ...]) -> tuple[PoseState, tuple[Photos, ...]]:
    """Start the poses at zero motion, and return photos whose viewmats the motions update."""
    start = photos[0].viewmats.astype(np.float64)
    zero, shared = np.zeros((len(start), 6)), start.copy()
    pixel = 1 / float(photos[0].Ks[:, [0, 1], [0, 1]].mean())
    state = PoseState(start, shared, zero, zero.copy(), zero.copy(), np.zeros(len(start), np.int64), pixel)
    return state, tuple(replace(level, viewmats=shared) for level in photos)
