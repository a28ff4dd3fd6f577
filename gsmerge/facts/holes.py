"""Scene -> the same with Gaussians where its views show something and its own Gaussians nothing.

Exporters drop borders, far regions and faint rows, and voxels leave gaps. Each view is drawn from its own camera; a
pixel that stays empty gets a Gaussian of its picture's colour. Its depth is that of the surface beside it or one beyond
the view's farthest surface: the depth at which the pictures of the nearest other views agree best.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.facts.mend_photos import fill_gaps
from gsmerge.geometry import rgb_to_sh0
from gsmerge.kernels.matrices import invert, matmul
from gsmerge.kernels.pictures import blur
from gsmerge.raster import TiledView
from gsmerge.raster.composite import blend
from gsmerge.raster.images import tile_views
from gsmerge.runtime.record import note
from gsmerge.types import Gaussians, PicturedScene, grid_ids

# Chosen on exports of eight captures as Depth Anything 3 writes them, and the same with shuffled and with merged rows.
EMPTY = 0.75  # opacity of the drawing below which a pixel is empty
MOST = 0.5  # share of empty pixels from which on rows without pixels may be a part of what the photos show
FACTORS = 2.0 ** np.linspace(0, 3, 13)  # of the depth of a view's farthest surface: depths that are tried
FARTHEST = 0.99  # quantile of the depths that counts as the farthest
FARTHER = 0.001  # difference of colours, sRGB, that each next depth must gain
OTHERS = 3  # nearest views that a picture is compared with
BLUR = 3.0  # standard deviation of the window over which differences are averaged, pixels
LEAST = 1e-3  # weight in that window of the pixels that other views see
SIZE, OPACITY = 0.75, 0.9  # of a new Gaussian: standard deviation in pixels


def fill_holes(scene: PicturedScene, shown: np.ndarray) -> PicturedScene:
    """Add a Gaussian at each pixel of a canonical scene that no Gaussian covers; add a note.

    ``shown [v,h,w]``: pixels whose picture says what is there. Where rows belong to pixels, only pixels without a row
    get a Gaussian, which takes their row. Elsewhere the new Gaussians follow the others, and none is added where most
    pixels are empty: the scene may be a part of what the photos show.
    """
    free = shown & ~scene.valid if scene.aligned else shown
    if not free.any():
        return scene
    holes, parts = np.zeros_like(free), dict[int, Gaussians]()

    def fill(view: int, tiled: TiledView) -> None:
        depths = np.repeat(tiled.depths[:, None], 3, 1)
        blended, left = blend(tiled, depths, np.zeros(3, np.float32))
        covered = left <= 1 - EMPTY
        holes[view] = free[view] & ~covered
        if covered.any() and holes[view].any():
            parts[view] = _fill_view(scene, view, holes[view], covered, blended[..., 0] / np.maximum(1 - left, 1e-6))

    tile_views(scene, fill)
    if not parts or not (scene.aligned or np.count_nonzero(holes) < MOST * np.count_nonzero(shown)):
        return scene
    added = Gaussians.concat([parts[view] for view in sorted(parts)])
    note(f"{len(added):,} pixels that no Gaussian covers are filled with the colours of their pictures")
    if not scene.aligned:
        return replace(scene, gaussians=Gaussians.concat([scene.gaussians, added]))
    holes[[view for view in range(len(scene)) if view not in parts]] = False
    columns = {name: values.copy() for name, values in vars(scene.gaussians).items()}
    for name, values in vars(added).items():
        columns[name][holes.reshape(-1)] = values
    return replace(scene, gaussians=Gaussians(**columns), pixel_ids=grid_ids(scene.valid | holes))


def _fill_view(
    scene: PicturedScene, view: int, holes: np.ndarray, covered: np.ndarray, depths: np.ndarray
) -> Gaussians:
    """Make a Gaussian for each of a view's ``holes [h,w]``, given ``depths [h,w]`` where it is ``covered [h,w]``."""
    cameras, shN = scene.cameras, scene.gaussians.shN
    y, x = np.nonzero(holes)
    pixels = np.stack([x + 0.5, y + 0.5, np.ones(len(x))], 1)
    rays = matmul(matmul(pixels, invert(cameras.Ks[view]).T), cameras.viewmats[view, :3, :3])  # to depth 1
    beside = fill_gaps(depths[..., None], covered)[..., 0][holes].astype(np.float64)
    beyond = float(np.quantile(depths[covered], FARTHEST)) * FACTORS[:, None]
    tried = np.concatenate([beside[None], np.maximum(beyond, beside)])
    depth = _agreeing(scene, view, holes, rays, tried)
    size = SIZE * depth / cameras.Ks[view, 0, 0]
    return Gaussians(
        means=(cameras.centres[view] + depth[:, None] * rays).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (len(x), 1)),
        scales=np.repeat(size[:, None], 3, 1).astype(np.float32),
        opacities=np.full(len(x), OPACITY, np.float32),
        sh0=rgb_to_sh0(scene.images[view][holes])[:, None].astype(np.float32),
        shN=np.zeros((len(x), *shN.shape[1:]), np.float32),
    )


def _agreeing(scene: PicturedScene, view: int, holes: np.ndarray, rays: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Choose one of ``depths [d,n]`` along each of ``rays [n,3]``: where the nearest other views show the same colour.

    The differences of colours are averaged over the ``holes [h,w]`` around. In doubt it is the first depth.
    """
    cameras, centres = scene.cameras, scene.cameras.centres
    away = ((centres - centres[view]) ** 2).sum(1)
    others = [other for other in np.argsort(away, kind="stable") if away[other] > 0][:OTHERS]
    moves = []
    for other in others:
        K, (turn, shift) = cameras.Ks[other], np.split(cameras.viewmats[other, :3], [3], 1)
        start = matmul(K, matmul(turn, centres[view]) + shift[:, 0])
        moves.append((scene.images[other], matmul(matmul(rays, turn.T), K.T).T.copy(), start))
    colors, size = scene.images[view][holes], np.array([[cameras.width], [cameras.height]])
    chosen, least = depths[0].copy(), np.full(len(rays), np.inf)
    for step, depth in enumerate(depths):
        sums = np.zeros((2, len(rays)), np.float32)  # of differences, and their number
        for image, along, start in moves:
            x, y, z = along * depth + start[:, None]
            with np.errstate(divide="ignore", invalid="ignore"):
                place = np.floor(np.stack([x, y]) / z)
            seen = np.flatnonzero((z > 0) & ((place >= 0) & (place < size)).all(0))
            column, row = place[:, seen].astype(np.int64)
            apart = np.abs(image[row, column] - colors[seen])
            sums[0, seen] += (apart[:, 0] + apart[:, 1] + apart[:, 2]) / 3
            sums[1, seen] += 1
        pictures = np.zeros((*holes.shape, 2), np.float32)
        pictures[holes] = sums.T
        total, number = blur(pictures, BLUR)[holes].T
        cost = np.where(number > LEAST, total / np.maximum(number, LEAST), np.inf) + FARTHER * step
        better = cost < least
        chosen[better], least[better] = depth[better], cost[better]
    return chosen
