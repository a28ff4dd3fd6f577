"""Pixels that an exporter dropped although their depth is known, put back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gsmerge.geometry import rgb_to_sh0
from gsmerge.types import PixelScene

_MAX_SPREAD = 0.15  # of the Gaussians' depth over the map's: above it the map is not that of the Gaussians


def fill_from_depths(scene: PixelScene, depths: np.ndarray) -> PixelScene:
    """The scene with a Gaussian for each pixel that the file has no row for.

    It lies on the pixel's ray at the depth of the map, in units that follow from the other pixels (as depth along z or
    as distance, whichever they agree with). Its colour is the photo's; its opacity, rotation and size in pixels are
    those of the pixel before it in the same row.

    Args:
        scene: With photos; on the full grid.
        depths: ``[v,h,w]`` of its views.

    Returns:
        The scene as it was if it has no photos, lacks nothing, or its Gaussians do not lie at the maps' depths.
    """
    if scene.images is None or scene.missing is None:
        return scene
    V, Ks = scene.cameras.viewmats.double().numpy(), scene.cameras.Ks.double().numpy()
    views, height, width = scene.valid.shape
    valid, g = scene.valid.numpy().reshape(views, -1), scene.gaussians
    means = g.means.double().numpy().reshape(views, -1, 3)
    y, x = np.mgrid[:height, :width].reshape(2, -1) + 0.5
    pixels = np.stack([x, y, np.ones(x.size)], 1)
    rays = pixels @ np.linalg.inv(Ks).transpose(0, 2, 1)  # [v,p,3] in the camera, z = 1
    z = np.einsum("vi,vpi->vp", V[:, 2, :3], means) + V[:, 2, 3, None]
    length = np.linalg.norm(rays, axis=2)
    maps = depths.reshape(views, -1).astype(np.float64)
    usable = valid & (maps > 0) & np.isfinite(maps) & (z > 0)
    if not usable.any():
        return scene
    ratio = z[usable] / maps[usable]
    spread, unit, along = min(_agreement(ratio, 0), _agreement(ratio * length[usable], 1))
    if spread > _MAX_SPREAD:
        return scene
    new_z = unit * maps / (length if along else 1)
    ranks = np.arange(usable.size).reshape(usable.shape)
    before = np.maximum.accumulate(np.where(usable, ranks, 0), axis=1).reshape(-1)
    before = np.where(usable.reshape(-1)[before], before, np.flatnonzero(usable)[0])
    rows = np.flatnonzero(~valid & (maps > 0) & np.isfinite(maps))
    view = rows // (height * width)
    local = rays.reshape(-1, 3)[rows] * new_z.reshape(-1)[rows, None]
    world = np.einsum("tji,tj->ti", V[view, :3, :3], local - V[view, :3, 3])
    source, at = torch.from_numpy(before[rows]), torch.from_numpy(rows)
    columns = {name: getattr(g, name).clone() for name in ("means", "quats", "scales", "opacities", "sh0", "shN")}
    columns["means"][at] = torch.from_numpy(world).to(g.means.dtype)
    growth = torch.from_numpy(new_z.reshape(-1)[rows] / z.reshape(-1)[before[rows]]).float()
    columns["scales"][at] = g.scales[source] * growth[:, None]
    columns["quats"][at], columns["opacities"][at] = g.quats[source], g.opacities[source]
    columns["sh0"][at] = rgb_to_sh0(scene.images.reshape(-1, 1, 3)[at])
    kept = scene.valid.reshape(-1).clone()
    kept[at] = True
    return replace(scene, gaussians=type(g)(**columns), valid=kept.reshape(scene.valid.shape))


def _agreement(ratio: np.ndarray, far: int) -> tuple[float, float, int]:
    """(spread, median, kind) of the Gaussians' depth over the map's."""
    middle = float(np.median(ratio))
    return float(np.median(np.abs(ratio / middle - 1))), middle, far
