"""Find the pixels of a view that show what the input views have seen (supplement A)."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from gsmerge.method.geometry.transforms import is_inside, median, project
from gsmerge.method.kernels.matrices import invert, matmul
from gsmerge.method.kernels.reproject import mark_pixels
from gsmerge.method.raster import render
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Scene

Points = NDArray[np.float64]  # [n,3]
VISIBILITY_GAUSSIANS = 200_000  # largest sample of Gaussians on which a share is measured
_CHUNK = 1 << 16  # number of points that are processed at a time; often the first points already mark all pixels


def context_points(scene: Scene, near: float, cameras: Cameras | None = None) -> Points:
    """Return the surface points ``[n,3]``, in world units, that the pixels of the input views show.

    If each Gaussian comes from one view, the points are the means of the Gaussians. Otherwise the points are computed
    from depths, rendered beyond ``near`` (world units) in ``cameras``. None: the scene's cameras.
    """
    if scene.has_own_pixels:
        return scene.file_gaussians.means.astype(np.float64)
    cameras = scene.cameras if cameras is None else cameras
    points = []
    for view in range(len(cameras)):
        camera = cameras[[view]]
        drawn = render(scene.gaussians, camera, near=near, with_depths=True)
        assert drawn.depths is not None
        depths = drawn.depths[0, ..., 0]
        min_alpha = 0.5  # least alpha of a pixel whose rendered depth is that of a surface
        y, x = np.nonzero(drawn.alphas[0, ..., 0] > min_alpha)
        rays = matmul(np.stack([x + 0.5, y + 0.5, np.ones(len(x))], 1), invert(camera.Ks[0].astype(np.float64)).T)
        pose = invert(camera.viewmats[0].astype(np.float64))
        points.append(matmul(rays * depths[y, x, None].astype(np.float64), pose[:3, :3].T) + pose[:3, 3])
    return np.concatenate(points)


def visible_pixels(points: Points, cameras: Cameras, near: float, sources: Cameras | None = None) -> NDArray[np.bool_]:
    """Return masks ``[c,h,w]`` of the pixels that show one of the ``points [n,3]``, or are next to such a pixel.

    A point also counts if a surface hides it, but not if it is nearer than ``near`` (world units). ``sources`` are the
    cameras whose pixels gave the points. If the views have smaller pixels than ``sources``, a point marks more pixels
    in proportion, so that there are no gaps.
    """
    viewmats, Ks = cameras.viewmats.astype(np.float64, "C"), cameras.Ks.astype(np.float64, "C")

    def mark_view(view: int) -> NDArray[np.bool_]:
        """Return the mask ``[h,w]`` of one view."""
        hit = np.zeros((cameras.height, cameras.width), np.uint8)
        seen = hit > 0
        side = 3  # least side of the square that a point marks, pixels
        if sources is not None:
            # The square covers the same angle as so many pixels of ``sources``, if this makes the square larger
            focal, source_focals = (
                np.sqrt(K[..., 0, 0] * K[..., 1, 1]) for K in (Ks[view], sources.Ks.astype(np.float64))
            )
            side = max(side, 2 * round((side * float(focal / median(source_focals)) - 1) / 2) + 1)
        first = len(points) * view // len(cameras)  # in most scenes the view's own points begin here
        for start in (*range(first, len(points), _CHUNK), *range(0, first, _CHUNK)):
            mark_pixels(points[start : start + _CHUNK], viewmats[view], Ks[view], near, hit)
            seen = cv2.dilate(hit, np.ones((side, side), np.uint8)) > 0
            if seen.all():
                break
        return seen

    return np.stack(parallel_map(mark_view, range(len(cameras))))


def inside_views(points: np.ndarray, cameras: Cameras) -> Iterator[np.ndarray]:
    """Yield, for each view, the mask ``[n]`` of the points ``[n,3]`` inside its picture."""
    at_once = 1 + _CHUNK // max(1, len(points))
    for start in range(0, len(cameras), at_once):
        pixels, depths = project(points, cameras[start : start + at_once])
        yield from (depths > 0) & is_inside(pixels, cameras)
