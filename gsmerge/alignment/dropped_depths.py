"""Fill pixels that an exporter dropped, at borders and far away, from depth maps."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from gsmerge.geometry import camera_depths, median, rgb_to_sh0, vector_lengths
from gsmerge.kernels.matrices import invert, matmul
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Gaussians, Scene, fill_pixels

_MAX_SPREAD = 0.15  # median relative deviation of depth ratios; above it the map does not belong to the Gaussians


def fill_from_depths(scene: Scene, maps: np.ndarray, images: np.ndarray) -> Scene:
    """Add a Gaussian at the depth of ``maps [v,h,w]`` for each pixel without a Gaussian.

    The unit of the maps follows from the pixels with a Gaussian, and so does their kind: depth along z or distance. New
    Gaussians have the colours of the photos ``images [v,h,w,3]``. Their opacity, rotation and size in pixels
    are copied from the previous pixel with a Gaussian. The scene is returned unchanged if its Gaussians do not lie at
    the depths of the maps.
    """
    maps = maps.reshape(len(scene), -1)
    places, added = _make_gaussians(scene, maps, images)
    return scene if added is None else fill_pixels(scene, added, places)


def _make_gaussians(scene: Scene, maps: np.ndarray, images: np.ndarray) -> tuple[np.ndarray, Gaussians | None]:
    """Return the pixels ``[n]`` to fill, and their Gaussians; None if the Gaussians do not lie at the depths."""
    g, fronts = scene.gaussians, scene.get_pixels().fronts.reshape(maps.shape)
    empty = np.flatnonzero((fronts < 0) & _have_depth(maps))  # pixels that get a Gaussian
    z, lengths, usable = _measure_depths(scene, maps)
    if not usable.any():
        return empty, None
    spread, unit, is_distance = _fit_unit(z[usable], maps[usable].astype(np.float64), lengths[usable])
    if spread > _MAX_SPREAD:
        return empty, None
    new_z = unit * maps.reshape(-1)[empty].astype(np.float64) / (lengths.reshape(-1)[empty] if is_distance else 1)
    previous = np.flatnonzero(usable)
    previous = previous[np.maximum(np.searchsorted(previous, empty) - 1, 0)]
    models = g[fronts.reshape(-1)[previous]]
    scales = models.scales * (new_z / z.reshape(-1)[previous]).astype(np.float32)[:, None]
    sh0 = rgb_to_sh0(images.reshape(-1, 1, 3)[empty]).astype(g.sh0.dtype)
    means = _unproject(scene.cameras, empty, new_z).astype(g.means.dtype)
    return empty, Gaussians(means, models.quats, scales, models.opacities, sh0, np.zeros_like(models.shN))


def _measure_depths(scene: Scene, maps: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Measure the pixels of all views ``[v,p]``, view by view since a page of memory is slow at first use.

    Returns the depths of the Gaussians in front, the distances of points at depth 1, and a mask of the pixels with both
    a Gaussian and a depth in ``maps [v,p]``.
    """
    g, viewmats, fronts = scene.gaussians, scene.cameras.viewmats, scene.get_pixels().fronts.reshape(maps.shape)
    z, lengths, usable = np.empty(maps.shape), np.empty(maps.shape), np.empty(maps.shape, bool)

    def measure(view: int) -> None:
        z[view] = camera_depths(g.means[fronts[view]].astype(np.float64), viewmats[view])
        lengths[view] = vector_lengths(_make_rays(scene.cameras, view))[:, 0]
        usable[view] = (fronts[view] >= 0) & _have_depth(maps[view]) & (z[view] > 0)

    parallel_map(measure, range(len(maps)))
    return z, lengths, usable


def _have_depth(maps: np.ndarray) -> np.ndarray:
    """Return a mask of the pixels of depth maps that have a depth."""
    return np.asarray((maps > 0) & np.isfinite(maps))


def _make_rays(cameras: Cameras, view: int) -> np.ndarray:
    """Return the points ``[p,3]`` at depth 1 on the rays of all pixels of a view, in the frame of its camera."""
    y, x = np.mgrid[: cameras.height, : cameras.width].reshape(2, -1) + 0.5
    pixels = np.stack([x, y, np.ones(x.size)], 1)
    return matmul(pixels, invert(cameras.Ks[view]).T)


def _unproject(cameras: Cameras, places: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return points ``[n,3]`` of the world at depths ``z [n]`` on the rays of pixels.

    ``places [n]`` number the pixels over all views, and ascend.
    """
    points, pixels = np.empty((len(places), 3)), cameras.width * cameras.height
    ends = np.searchsorted(places, pixels * np.arange(len(cameras) + 1)).tolist()
    for view, (start, end) in enumerate(pairwise(ends)):
        rows, viewmat = slice(start, end), cameras.viewmats[view]
        local = _make_rays(cameras, view)[places[rows] - view * pixels] * z[rows, None] - viewmat[:3, 3]
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
