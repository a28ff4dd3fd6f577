"""Views contradict others by random motions, or by nearer depths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge import Scene
from gsmerge.method.geometry.transforms import motion_matrices, move_views
from gsmerge.method.kernels.matrices import matmul


def random_motions(count: int, degrees: float, shift: float) -> np.ndarray:
    """Draw ``[count,4,4]`` motions that all turn and shift by as much, each in a direction of its own."""
    parts = np.random.default_rng(2).normal(size=(2, count, 3))
    parts /= np.linalg.norm(parts, axis=2, keepdims=True)
    return motion_matrices(np.concatenate([np.deg2rad(degrees) * parts[0], shift * parts[1]], 1))


def disagreeing(scene: Scene, degrees: float = 0.8, shift: float = 0.01, views: slice = slice(None)) -> Scene:
    """Return the scene with some views moved, each camera with its Gaussians."""
    viewmats = scene.cameras.viewmats.astype(np.float64)
    viewmats[views] = matmul(random_motions(len(scene), degrees, shift), viewmats)[views]
    return move_views(scene, viewmats)


def with_nearer_half(scene: Scene, views: list[int]) -> Scene:
    """Put the right half of some views, with a Gaussian for each pixel, at six tenths of its depth."""
    count, width, height = len(scene), scene.cameras.width, scene.cameras.height
    means = scene.gaussians.means.reshape(count, height, width, 3).copy()
    for view in views:
        eye = scene.cameras.centres[view]
        means[view, :, width // 2 :] = eye + 0.6 * (means[view, :, width // 2 :] - eye)
    return replace(scene, gaussians=replace(scene.gaussians, means=means.reshape(-1, 3)))
