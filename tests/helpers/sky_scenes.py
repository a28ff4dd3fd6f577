"""This room is under a painted sky."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scenes

from gsmerge import Scene
from gsmerge.types import SH_C0

WIDTH, HEIGHT, HORIZON = 96, 72, 30
ZENITH, HAZE = np.array([0.35, 0.6, 0.95]), np.array([0.85, 0.92, 0.98])
OVERCAST, CEILING = np.array([0.85, 0.86, 0.88]), np.array([0.85, 0.83, 0.78])


def painted(top: np.ndarray, bottom: np.ndarray, depth: float = 1.0) -> tuple[Scene, np.ndarray]:
    """Paint over a room's upper part, from one colour to another, at so many times its depth; return where, too."""
    scene = scenes.make_scene(scenes.room(), scenes.arc(4, WIDTH, HEIGHT))
    images, colors = scene.images.copy(), scene.gaussians.sh0.copy()
    shade = np.linspace(0, 1, HORIZON)[:, None, None]
    images[:, :HORIZON] = (1 - shade) * top + shade * bottom
    painted = np.zeros(images.shape[:3], bool)
    painted[:, :HORIZON] = True
    rows = painted.reshape(-1)
    colors[rows, 0] = (images[painted] - 0.5) / SH_C0
    means, scales = scene.gaussians.means.copy(), scene.gaussians.scales.copy()
    centres = np.repeat(scene.cameras.centres, HEIGHT * WIDTH, 0)[rows]
    means[rows] = centres + depth * (means[rows] - centres)
    scales[rows] *= depth
    gaussians = replace(scene.gaussians, means=means.astype(np.float32), scales=scales, sh0=colors)
    return replace(scene, gaussians=gaussians, images=images.astype(np.float32)), rows
