"""Which pixels of a view show what the input views have seen; the rest is extrapolation (supplement A)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gsmerge.render import render
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Gaussians, Scene

Points = NDArray[np.float64]  # [n,3]
_OPAQUE = 0.5  # alpha from which a rendered depth is that of a surface
_CHUNK = 1 << 18  # points at a time: all of them, in every thread, would take too much memory
_DILATION = 3  # pixels of the input views per side of the square that every sample marks


def context_points(scene: Scene, near: float) -> Points:
    """``[n,3]`` a point in the world for every pixel of the input views: their depth samples.

    Of a scene with pixels the Gaussians are the samples; otherwise depth beyond ``near``, world units, is rendered.
    """
    if scene.aligned:
        return scene.gaussians.means[scene.valid.reshape(-1)].astype(np.float64)
    return np.concatenate([_rendered_points(scene.gaussians, scene.cameras[[i]], near) for i in range(len(scene))])


def _rendered_points(gaussians: Gaussians, camera: Cameras, near: float) -> Points:
    drawn = render(gaussians, camera, near=near, with_depths=True)
    assert drawn.depths is not None
    depth, solid = drawn.depths[0].astype(np.float64), drawn.alphas[0] > _OPAQUE
    y, x = np.nonzero(solid.reshape(depth.shape[:2]))
    rays = np.stack([x + 0.5, y + 0.5, np.ones(len(x))], 1) @ np.linalg.inv(camera.Ks[0].astype(np.float64)).T
    pose = np.linalg.inv(camera.viewmats[0].astype(np.float64))
    return np.asarray((rays * depth.reshape(solid.shape[0], -1)[y, x, None]) @ pose[:3, :3].T + pose[:3, 3])


def visible_pixels(points: Points, cameras: Cameras, near: float, sources: Cameras | None = None) -> NDArray[np.bool_]:
    """``[c,h,w]`` pixels on which, or next to which, at least one of the points ``[n,3]`` falls, whatever occludes it.

    Points nearer than ``near``, world units, do not count. Where the views have smaller pixels than those that the
    points come from (``sources``), a point marks proportionally more of them, as there would be gaps otherwise.
    """
    viewmats, Ks = cameras.viewmats.astype(np.float64), cameras.Ks.astype(np.float64)
    size = np.array([cameras.width, cameras.height])

    def one_view(view: int) -> NDArray[np.bool_]:
        hit = np.zeros((cameras.height, cameras.width), np.uint8)
        for first in range(0, len(points), _CHUNK):
            some = points[first : first + _CHUNK]
            image = (some @ viewmats[view, :3, :3].T + viewmats[view, :3, 3]) @ Ks[view].T
            image = image[image[:, 2] > near]
            pixels = np.floor(image[:, :2] / image[:, 2:])
            pixels = pixels[((pixels >= 0) & (pixels < size)).all(1)].astype(np.int64)
            hit[pixels[:, 1], pixels[:, 0]] = 1
        side = _side(Ks[view], sources)
        return cv2.dilate(hit, np.ones((side, side), np.uint8)) > 0

    return np.stack(parallel_map(one_view, range(len(cameras))))


def _side(K: np.ndarray, sources: Cameras | None) -> int:
    """Pixels per side, an odd number, of the square that a sample marks in a view with the intrinsics ``K [3,3]``."""
    if sources is None:
        return _DILATION
    focals = [np.sqrt(one[..., 0, 0] * one[..., 1, 1]) for one in (K, sources.Ks.astype(np.float64))]  # pixels
    return max(_DILATION, 2 * round((_DILATION * float(focals[0] / np.median(focals[1])) - 1) / 2) + 1)
