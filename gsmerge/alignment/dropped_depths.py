"""Fill pixels that an exporter dropped, at borders and far away, from depth maps."""

from __future__ import annotations

from itertools import pairwise, starmap

import numpy as np

from gsmerge.geometry import camera_depths, median, rgb_to_sh0, vector_lengths
from gsmerge.kernels.matrices import invert, matmul
from gsmerge.types import Cameras, Gaussians, Scene, fill_pixels

_MAX_SPREAD = 0.15  # median relative deviation of depth ratios; above it the map does not belong to the Gaussians


def fill_from_depths(scene: Scene, maps: np.ndarray, images: np.ndarray) -> Scene:
    """Add a Gaussian at the depth of ``maps [v,h,w]`` for each pixel without a Gaussian.

    The unit of the maps follows from the pixels with a Gaussian, and so does their kind: depth along z or distance. New
    Gaussians have the colours of the photos ``images [v,h,w,3]``. Their opacity, rotation and size in pixels
    are copied from the previous pixel with a Gaussian. The scene is returned unchanged if its Gaussians do not lie at
    the depths of the maps.
    """
    g, V, fronts = scene.gaussians, scene.cameras.viewmats, scene.get_pixels().fronts.reshape(len(scene), -1)
    rays = _make_rays(scene.cameras)
    z = camera_depths(g.means[fronts].astype(np.float64), V[:, None])
    lengths, maps = vector_lengths(rays)[..., 0], maps.reshape(len(scene), -1).astype(np.float64)
    has_depth = (maps > 0) & np.isfinite(maps)
    usable = (fronts >= 0) & has_depth & (z > 0)
    if not usable.any():
        return scene
    spread, unit, is_distance = _fit_unit(z[usable], maps[usable], lengths[usable])
    if spread > _MAX_SPREAD:
        return scene
    empty = np.flatnonzero((fronts < 0) & has_depth)  # pixels that get a Gaussian
    new_z = (unit * maps / (lengths if is_distance else 1)).reshape(-1)[empty]
    means = _unproject(rays, new_z, V, empty)
    previous = np.flatnonzero(usable)
    previous = previous[np.maximum(np.searchsorted(previous, empty) - 1, 0)]
    models = g[fronts.reshape(-1)[previous]]
    scales = models.scales * (new_z / z.reshape(-1)[previous]).astype(np.float32)[:, None]
    sh0 = rgb_to_sh0(images.reshape(-1, 1, 3)[empty]).astype(g.sh0.dtype)
    means = means.astype(g.means.dtype)
    added = Gaussians(means, models.quats, scales, models.opacities, sh0, np.zeros_like(models.shN))
    return fill_pixels(scene, added, empty)


def _make_rays(cameras: Cameras) -> np.ndarray:
    """Return the points ``[v,p,3]`` at depth 1 on the rays of all pixels, in the frame of each camera."""
    y, x = np.mgrid[: cameras.height, : cameras.width].reshape(2, -1) + 0.5
    pixels = np.stack([x, y, np.ones(x.size)], 1)
    return matmul(pixels, invert(cameras.Ks).transpose(0, 2, 1))


def _unproject(rays: np.ndarray, z: np.ndarray, viewmats: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return points ``[n,3]`` of the world at depths ``z [n]`` on the rays of some pixels.

    ``rays [v,p,3]`` are those of all pixels of cameras ``viewmats [v,4,4]``. ``places [n]`` number the pixels over all
    views, and ascend.
    """
    points, (views, pixels, _) = np.empty((len(places), 3)), rays.shape
    ends = np.searchsorted(places, pixels * np.arange(views + 1)).tolist()
    for view, (viewmat, rows) in enumerate(zip(viewmats, starmap(slice, pairwise(ends)), strict=True)):
        local = rays[view, places[rows] - view * pixels] * z[rows, None] - viewmat[:3, 3]
        for axis, (a, b, c) in enumerate(viewmat[:3, :3].T):
            points[rows, axis] = a * local[:, 0] + b * local[:, 1] + c * local[:, 2]
    return points


def _fit_unit(z: np.ndarray, maps: np.ndarray, lengths: np.ndarray) -> tuple[float, float, bool]:
    """Find the unit of depth maps, and whether they hold distances from the camera instead of depths along z.

    ``z [n]`` are depths of Gaussians, ``maps [n]`` the depths of the maps in the same pixels, and ``lengths [n]`` the
    distances of points at depth 1. The better of both kinds is returned, with its spread first: the median relative
    deviation of the ratios.
    """
    fits = []
    for is_distance, ratios in ((False, z / maps), (True, z / maps * lengths)):
        unit = median(ratios)
        fits.append((median(np.abs(ratios / unit - 1)), unit, is_distance))
    return min(fits)
