"""The cameras as parameters of the full fit: a motion of each, by the renderer's own gradient."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmerge.geometry import motion_matrices
from gsmerge.render.photos import Photos
from gsmerge.stages.fit.options import Tuning

EPS = 1e-15  # of Adam


@dataclass(eq=False)
class PoseState:
    """Motions of the views under optimisation, whose mean is none, so that the scene stays where it is.

    Args:
        start: ``[v,4,4]`` viewmats before the fit.
        viewmats: ``[v,4,4]`` float64, written by every step; the photos of all sizes share them.
        x: ``[v,6]`` motion of each, see :func:`gsmerge.geometry.motion_vectors`: about the scene's middle, where turns
            and shifts of a camera show differently.
        m: First moment.
        v: Second moment.
        counts: ``[v]`` steps of each.
        pixel: Angle of a pixel, radians, which is also its size at the scene's depth, canonical units.
    """

    start: np.ndarray
    viewmats: np.ndarray
    x: np.ndarray
    m: np.ndarray
    v: np.ndarray
    counts: np.ndarray
    pixel: float

    def step(self, view: int, gradient: np.ndarray, rates: Tuning, progress: float) -> None:
        """One Adam step of a view by the gradient ``[4,4]`` of its viewmat; steps fall to nothing at the end."""
        turns = self.viewmats[view, :3, :3].T @ gradient[:3]
        (_, ab, ac), (ba, _, bc), (ca, cb, _) = turns[:, :3]
        slope = np.array([cb - bc, ac - ca, ba - ab, *turns[:, 3]])
        self.counts[view] += 1
        for moment, beta, value in ((self.m, rates.beta1, slope), (self.v, rates.beta2, slope**2)):
            moment[view] += (1 - beta) * (value - moment[view])
        first = self.m[view] / (1 - rates.beta1 ** self.counts[view])
        second = self.v[view] / (1 - rates.beta2 ** self.counts[view])
        self.x[view] -= rates.poses_lr * self.pixel * (1 - progress) * first / (np.sqrt(second) + EPS)
        self.x -= self.x.mean(0)
        self.viewmats[:] = self.start @ motion_matrices(self.x)


def start_poses(photos: tuple[Photos, ...]) -> tuple[PoseState, tuple[Photos, ...]]:
    """Motions at the poses of some photos, and the photos with viewmats that they share with it."""
    start = photos[0].viewmats.astype(np.float64)
    zero, shared = np.zeros((len(start), 6)), start.copy()
    pixel = 1 / float(photos[0].Ks[:, [0, 1], [0, 1]].mean())
    state = PoseState(start, shared, zero, zero.copy(), zero.copy(), np.zeros(len(start), np.int64), pixel)
    return state, tuple(replace(some, viewmats=shared) for some in photos)
