"""Move cameras during a fit."""

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
    """Motions of the cameras during a fit. The mean of the motions stays zero, so that the scene does not drift."""

    start: np.ndarray  # [v,4,4] viewmats before the fit
    viewmats: np.ndarray  # [v,4,4] float64; steps update it in place, and all sizes of the photos share it
    # [v,6] motion of each camera, see transforms.motion_vectors. Cameras rotate about the middle of the scene, because
    # a rotation of a camera about its own centre looks like a shift
    x: np.ndarray
    m: np.ndarray  # [v,6] first moments of Adam
    v: np.ndarray  # [v,6] second moments of Adam
    counts: np.ndarray  # [v] number of steps that each camera has taken
    pixel: float  # Angle of a pixel in radians, which is also its size at the middle depth of the scene

    def step(self, view: int, gradient: np.ndarray, rates: Tuning, progress: float) -> None:
        """Move a view by one Adam step (Nadam) down the gradient ``[4,4]`` of its viewmat, and update all viewmats.

        ``progress`` is the share of the fit that is done. The size of the steps falls to zero at the end of the fit.
        """
        local = matmul(self.viewmats[view, :3, :3].T, gradient[:3])
        (_, xy, xz), (yx, _, yz), (zx, zy, _) = local[:, :3]
        slope = np.array([zy - yz, xz - zx, yx - xy, *local[:, 3]])  # derivatives by the rotation vector and the shift
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
    """Return cameras that have not moved yet, and the photos of all sizes with the viewmats that steps will update."""
    start = photos[0].viewmats.astype(np.float64)
    count = len(start)
    state = PoseState(
        start=start,
        viewmats=start.copy(),
        x=np.zeros((count, 6)),
        m=np.zeros((count, 6)),
        v=np.zeros((count, 6)),
        counts=np.zeros(count, np.int64),
        pixel=1 / float(photos[0].Ks[:, [0, 1], [0, 1]].mean()),
    )
    return state, tuple(replace(level, viewmats=state.viewmats) for level in photos)
