"""Fill pixels that an exporter dropped, borders and the farthest ones, from depth maps."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from gsmerge.geometry import rgb_to_sh0
from gsmerge.kernels.matrices import invert, matmul
from gsmerge.types import Gaussians, Scene, grid_ids

_MAX_SPREAD = 0.15  # of the Gaussians' depth over a depth map's: above it the map is not that of the Gaussians


def fill_from_depths(scene: Scene, depths: np.ndarray, images: np.ndarray) -> Scene:
    """Add a Gaussian at the depth of ``depths [v,h,w]`` for each pixel without a row in the file.

    The unit of the depths, and whether they are along z or distances, follow from the other pixels. Colours are those
    of the photos ``images [v,h,w,3]``. Opacity, rotation and size in pixels are copied from the previous pixel of the
    line. The scene is returned unchanged if its Gaussians do not lie at the depths of the maps.
    """
    V = scene.cameras.viewmats
    views, height, width = scene.valid.shape
    valid, g = scene.valid.reshape(views, -1), scene.gaussians
    means = g.means.astype(np.float64).reshape(views, -1, 3)
    y, x = np.mgrid[:height, :width].reshape(2, -1) + 0.5
    pixels = np.stack([x, y, np.ones(x.size)], 1)
    rays = matmul(pixels, invert(scene.cameras.Ks).transpose(0, 2, 1))  # [v,p,3] in the camera, z = 1
    z = matmul(means, V[:, 2, :3, None])[..., 0] + V[:, 2, 3, None]
    length = np.linalg.norm(rays, axis=2)
    maps = depths.reshape(views, -1).astype(np.float64)
    usable = valid & (maps > 0) & np.isfinite(maps) & (z > 0)
    if not usable.any():
        return scene
    ratio = z[usable] / maps[usable]
    fits = []
    for along, ratios in enumerate((ratio, ratio * length[usable])):  # depth along z, distance
        middle = float(np.median(ratios))
        fits.append((float(np.median(np.abs(ratios / middle - 1))), middle, along))
    spread, unit, along = min(fits)
    if spread > _MAX_SPREAD:
        return scene
    new_z = unit * maps / (length if along else 1)
    ranks = np.arange(usable.size).reshape(usable.shape)
    before = np.maximum.accumulate(np.where(usable, ranks, 0), axis=1).reshape(-1)
    before = np.where(usable.reshape(-1)[before], before, np.flatnonzero(usable)[0])
    rows = np.flatnonzero(~valid & (maps > 0) & np.isfinite(maps))
    view = rows // (height * width)
    local = rays.reshape(-1, 3)[rows] * new_z.reshape(-1)[rows, None]
    world = (V[view, :3, :3] * (local - V[view, :3, 3])[:, :, None]).sum(1)
    source = before[rows]
    full = Gaussians(**{field.name: getattr(g, field.name).copy() for field in fields(g)})
    full.means[rows] = world
    growth = new_z.reshape(-1)[rows] / z.reshape(-1)[source]
    full.scales[rows] = g.scales[source] * growth.astype(np.float32)[:, None]
    full.quats[rows], full.opacities[rows] = g.quats[source], g.opacities[source]
    full.sh0[rows] = rgb_to_sh0(images.reshape(-1, 1, 3)[rows])
    kept = scene.valid.reshape(-1).copy()
    kept[rows] = True
    return replace(scene, gaussians=full, pixel_ids=grid_ids(kept))
