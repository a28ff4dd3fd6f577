"""Fill pixels that an exporter dropped, borders and the farthest ones, from depth maps, or guess such maps."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from gsmerge.alignment.layouts import TRIMS, da3_trim
from gsmerge.geometry import camera_depths, project_points, rgb_to_sh0
from gsmerge.kernels.matrices import invert, matmul
from gsmerge.types import Gaussians, Scene, grid_ids

_MAX_SPREAD = 0.15  # of the Gaussians' depth over a depth map's: above it the map is not that of the Gaussians
_FACTORS = np.geomspace(1, 8, 13)  # of the largest depth that was kept: those of far pixels
_FARTHER = 0.003  # distance of colours, 0 to 1, that the next depth must gain
_LARGEST = 0.99  # quantile that counts as the largest
_OTHERS = 4  # nearest views that a photo is compared with
_AROUND = 6  # pixels on either side over which colours are compared


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


def guess_depths(scene: Scene, images: np.ndarray) -> np.ndarray:
    """Guess depth maps ``[v,h,w]`` along z from the photos, for a scene whose file lacks pixels.

    Pixels with rows keep their depths. For an inner pixel without a row, the candidates are the depth of the nearest
    pixel with a row, and several depths about the farthest one; the candidate with the most similar colours in the
    nearest other photos is chosen. Border pixels take the depth of the nearest pixel inside the border.
    """
    views, height, width = scene.valid.shape
    y, x = (_without_borders(np.asarray(scene.valid.any((0, 3 - axis)))) for axis in (1, 2))
    means = scene.gaussians.means.astype(np.float64).reshape(views, -1, 3)
    maps = np.empty((views, height, width))
    for view in range(views):
        kept = scene.valid[view]
        points = means[view]
        depth = camera_depths(points, np.broadcast_to(scene.cameras.viewmats[view], (len(points), 4, 4)))
        depth = depth.reshape(height, width)
        inner = np.zeros_like(kept)
        inner[np.ix_(y, x)] = ~kept[np.ix_(y, x)]
        if kept.any():
            beside = depth.reshape(-1)[_nearest_kept(kept)[inner]]
            farthest = float(np.quantile(depth[kept], _LARGEST))
            depths = np.concatenate([beside[None], np.repeat(farthest * _FACTORS[:, None], len(beside), 1)])
            depth[inner] = _agreeing_depths(scene, images, view, inner, depths)
        maps[view] = np.where(kept, depth, depth[np.ix_(y, x)])
    return maps


def _nearest_kept(kept: np.ndarray) -> np.ndarray:
    """Return for each pixel the index ``y·w + x [h,w]`` of the nearest kept pixel in its row or column.

    Where row and column have none, it is the first kept pixel of the picture. At least one pixel must be kept.
    """
    ids = np.arange(kept.size).reshape(kept.shape)
    least, chosen = np.full(kept.shape, kept.size), np.full(kept.shape, int(kept.argmax()))
    for axis, step in ((0, kept.shape[1]), (1, 1)):
        before = np.maximum.accumulate(np.where(kept, ids, -1), axis=axis)
        after = np.flip(np.minimum.accumulate(np.flip(np.where(kept, ids, kept.size), axis), axis=axis), axis)
        for nearest, missing in ((before, before < 0), (after, after == kept.size)):
            distance = np.where(missing, kept.size, np.abs(nearest - ids) // step)
            nearer = distance < least
            least[nearer], chosen[nearer] = distance[nearer], nearest[nearer]
    return chosen


def _without_borders(stored: np.ndarray) -> np.ndarray:
    """Return for each line of pixels its own index ``[l]``, or for a trimmed border that of the nearest inner line."""
    lines, first, last = len(stored), int(stored.argmax()), int(stored[::-1].argmax())
    most = max(TRIMS[0], da3_trim(lines))  # beyond, a line lacks pixels for another reason
    return np.arange(lines).clip(min(first, most), lines - 1 - min(last, most))


def _agreeing_depths(scene: Scene, images: np.ndarray, view: int, pixels: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Choose one of ``depths [d,p]`` for each of the ``pixels [h,w]``: that with the best agreement of photos.

    In doubt it is the first depth.
    """
    cameras = scene.cameras
    if not pixels.any():
        return depths[0]
    y, x = np.nonzero(pixels)
    places = np.stack([x + 0.5, y + 0.5, np.ones(len(x))], 1)
    rays = matmul(matmul(places, invert(cameras.Ks[view]).T), cameras.viewmats[view, :3, :3])
    centres = cameras.centres
    away = np.linalg.norm(centres - centres[view], axis=1)
    neighbours = np.argsort(away, kind="stable")[1 : 1 + _OTHERS]
    colors = images[view, y, x]
    costs = np.empty(depths.shape)
    for i, depth in enumerate(depths):
        points = centres[view] + depth[:, None] * rays
        seen = np.zeros((2, *pixels.shape))
        for neighbour in neighbours:
            with np.errstate(all="ignore"):
                xy, z = project_points(points, cameras.viewmats[neighbour], cameras.Ks[neighbour])
            inside = (z > 0) & (xy >= 0).all(1) & (xy < (cameras.width, cameras.height)).all(1)
            column, row = xy[inside].astype(np.int64).T
            seen[0, y[inside], x[inside]] += np.abs(colors[inside] - images[neighbour, row, column]).mean(1)
            seen[1, y[inside], x[inside]] += 1
        total, count = _sums_around(seen)[:, y, x]
        costs[i] = np.where(count > 0, total / np.maximum(count, 1), np.inf)
    finite = np.isfinite(costs).all(0)
    chosen = (costs + _FARTHER * np.arange(len(depths))[:, None]).argmin(0)
    if finite.any():
        chosen[~finite] = int(np.median(chosen[finite]))
    return depths[chosen, np.arange(len(x))]


def _sums_around(pictures: np.ndarray) -> np.ndarray:
    """Sum pictures ``[n,h,w]`` over squares around each pixel, zero outside."""
    side = 2 * _AROUND + 1
    padded = np.pad(pictures, ((0, 0), (_AROUND + 1, _AROUND), (_AROUND + 1, _AROUND)))
    total = padded.cumsum(1)
    rows = total[:, side:] - total[:, :-side]
    total = rows.cumsum(2)
    return np.asarray(total[:, :, side:] - total[:, :, :-side])
