"""Gaussians where views show none: exports have gaps.

Exporters drop borders, far regions and faint rows, and voxels leave gaps. Each view is drawn from its own camera; a
pixel that stays empty gets a Gaussian of its picture's colour. Its depth is that of the surface beside it or one beyond
the view's farthest surface: the depth at which the pictures of the nearest other views agree best.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from gsmerge.facts.photo_change import PhotoChange, change_large
from gsmerge.facts.row_colors import fill_gaps
from gsmerge.geometry import lies_inside, nearest_views, rgb_to_sh0
from gsmerge.kernels.compare_views import add_differences
from gsmerge.kernels.matrices import invert, matmul
from gsmerge.kernels.pictures import blur
from gsmerge.raster import TiledView
from gsmerge.raster.composite import blend_depths
from gsmerge.raster.images import tile_views
from gsmerge.runtime.record import note
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Gaussians, PicturedScene, fill_pixels

# Chosen on exports of eight captures as Depth Anything 3 writes them, and the same with shuffled and with merged rows.
EMPTY = 0.75  # opacity of the drawing below which a pixel is empty
# share of the usual opacity of a view, which is low where rows are thin, below which a pixel shows nothing, and below
# which there is nothing around it
NOTHING, SPARSE = 0.5, 0.25
LARGE, PART, RIM = 1 / 12, 0.12, 2  # of the longer side: squares in large parts that stay empty; their share
# of the picture, at least; pixels beside them that do not
GAP = 1 / 53  # of the longer side: beside large empty parts only narrower gaps in what is covered are filled
MOST = 0.5  # share of empty pixels from which on the scene may be a part of what the photos show
FACTORS = 2.0 ** np.linspace(0, 3, 13)  # of the depth of a view's farthest surface: depths that are tried
FARTHEST = 0.99  # quantile of the depths that counts as the farthest
FARTHER = 0.001  # difference of colours, sRGB, that each next depth must gain
OTHERS = 3  # nearest views that a picture is compared with
BLUR = 3.0  # standard deviation of the window over which differences are averaged, pixels
LEAST = 1e-3  # weight in that window of the pixels that other views see
SIZE, OPACITY = 0.75, 0.9  # of a new Gaussian: standard deviation in pixels
BARE = 0.02  # opacity up to which a pixel's own Gaussian shows nothing


def fill_holes(scene: PicturedScene, shown: np.ndarray, *, everywhere: bool = False) -> PicturedScene:
    """Add a Gaussian at each pixel of a canonical scene that no Gaussian covers, or leave large parts empty; add notes.

    ``shown [v,h,w]``: pixels whose picture says what is there. The new Gaussians follow the others. None is added where
    most of the pixels are empty: the scene may be a part of what the photos show. Large connected parts of a view
    without Gaussians stay empty, unless ``everywhere``: the scene was cut out, or its model left out the sky. Of a
    cropped scene all stays empty that it does not cover.
    """
    fronts, is_cropped = scene.get_pixels().fronts, scene.region is not None
    free, bare = shown & (fronts < 0), (fronts < 0) | (scene.gaussians.opacities[fronts] <= BARE)
    gaps = [
        view
        for view in range(len(scene))
        if is_cropped or free[view].any() or (not everywhere and large_parts(bare[view]).any())
    ]
    if not gaps:
        return scene
    holes, empty, edges = np.zeros_like(free), np.zeros_like(free), dict[int, _Edges]()
    gap = 2 * round(GAP * max(shown.shape[1:]) / 2) + 1

    def find(view: int, tiled: TiledView) -> None:
        depths, left = blend_depths(tiled)
        covered = left <= 1 - EMPTY
        opacity = 1 - left
        nothing = opacity < NOTHING * usual_opacity(opacity)
        if is_cropped:
            beside = np.ones((3, 3), np.uint8)  # no Gaussian ends between two pixels
            empty[view] = cv2.erode((nothing & ~shown[view]).astype(np.uint8), beside) > 0
        elif not everywhere:
            sparse = blur(opacity, gap / 4) < SPARSE * usual_opacity(opacity)  # at the edges of what was cut out
            empty[view] = large_parts(nothing & sparse)
        bare[view] = ~covered & ~empty[view]
        holes[view] = free[view] & bare[view]
        if empty[view].any():  # the edges of what was cut out are no holes
            around = np.ones((gap, gap), np.uint8)
            holes[view] &= cv2.morphologyEx(covered.astype(np.uint8), cv2.MORPH_CLOSE, around) > 0
        if covered.any() and holes[view].any():
            beside = fill_gaps(depths[..., None], covered)[..., 0][holes[view]]
            edges[view] = _Edges(beside, float(np.quantile(depths[covered], FARTHEST)))

    tile_views(scene, find, gaps)
    filled = scene
    if edges and np.count_nonzero(bare[gaps]) < MOST * np.count_nonzero(~empty[gaps]):
        filled = _add_holes(scene, holes, edges)
    return _leave_empty(filled, empty)


def usual_opacity(opacity: np.ndarray) -> float:
    """Return the mean of a picture's opacities where there is something to see: that weighted by themselves."""
    return float((opacity * opacity).sum() / max(float(opacity.sum()), 1e-6))


@dataclass(frozen=True, eq=False)
class _Edges:
    """Depths in a view around its n holes."""

    beside: np.ndarray  # [n] of the surface beside each
    farthest: float  # of the view's farthest surface


def _add_holes(scene: PicturedScene, holes: np.ndarray, edges: Mapping[int, _Edges]) -> PicturedScene:
    """Add Gaussians to a scene in the ``holes [v,h,w]`` of views with ``edges``, with a note."""
    views = sorted(edges)
    added = Gaussians.concat(parallel_map(lambda view: _fill_view(scene, view, holes[view], edges[view]), views))
    holes[[view for view in range(len(scene)) if view not in edges]] = False
    places = np.flatnonzero(holes)
    if scene.region is not None:
        inside = lies_inside(scene.region, added.means)
        added, places = added[inside], places[inside]
    if len(places):
        note(f"{len(added):,} pixels that Gaussians hardly cover, or not at all, get the colours of their pictures")
    return fill_pixels(scene, added, places)


def large_parts(empty: np.ndarray) -> np.ndarray:
    """Return the connected parts of a mask ``[h,w]`` that hold a large square, less a rim of some pixels.

    There are none where such squares cover little of the picture. Borders that exporters leave out, and gaps, are
    narrower, and the farthest tenth that Depth Anything 3 leaves out is less.
    """
    if empty.mean() < PART:
        return np.zeros_like(empty)
    side = 2 * round(LARGE * max(empty.shape) / 2) + 1
    square, rim = np.ones((side, side), np.uint8), np.ones((2 * RIM + 1,) * 2, np.uint8)
    opened = cv2.morphologyEx(empty.astype(np.uint8), cv2.MORPH_OPEN, square) > 0
    if opened.mean() < PART:
        return np.zeros_like(empty)
    _, labels = cv2.connectedComponents(empty.astype(np.uint8), connectivity=4)
    kept = np.isin(labels, labels[opened & empty])
    return np.asarray(cv2.erode(kept.astype(np.uint8), rim) > 0)


def _leave_empty(scene: PicturedScene, empty: np.ndarray) -> PicturedScene:
    """Make pictures black and of no account for scores where they are to stay ``empty [v,h,w]``.

    A note says so of photos that counted there.
    """
    if not empty.any() or empty.all():
        return scene
    counted = empty if scene.masks is None else empty & scene.masks
    share = round(100 * float(counted.mean()))
    if share:
        views = int(counted.any((1, 2)).sum())
        note(
            f"the scene shows nothing in large parts of {views} of {len(empty)} views, {share} % of all pixels:"
            " they stay empty, and photos do not count there; --set extent=photos fills them"
        )
    images = np.where(empty[..., None], np.float32(0), scene.images)
    masks, large = ~empty if scene.masks is None else scene.masks & ~empty, scene.large_photos
    if large is not None:
        black = np.zeros((*empty.shape[1:], 3), np.float32)
        large = change_large(large, [PhotoChange(cover=mask, colors=black) for mask in empty])
    return replace(scene, images=images, masks=masks, large_photos=large, empty=empty)


def _fill_view(scene: PicturedScene, view: int, holes: np.ndarray, edges: _Edges) -> Gaussians:
    """Make a Gaussian for each of a view's ``holes [h,w]``."""
    cameras, shN = scene.cameras, scene.gaussians.shN
    y, x = np.nonzero(holes)
    pixels = np.stack([x + 0.5, y + 0.5, np.ones(len(x))], 1)
    rays = matmul(matmul(pixels, invert(cameras.Ks[view]).T), cameras.viewmats[view, :3, :3])  # to depth 1
    beside, beyond = edges.beside.astype(np.float64), edges.farthest * FACTORS[:, None]
    tried = np.concatenate([beside[None], np.maximum(beyond, beside)])
    depth = _agreeing(scene, view, holes, rays, tried)
    eye, size = cameras.centres[view], SIZE / cameras.Ks[view, 0, 0]
    return make_gaussians(eye, rays, depth, size, scene.images[view][holes], shN.shape[1])


def make_gaussians(
    eye: np.ndarray, rays: np.ndarray, depths: np.ndarray, size: float, colors: np.ndarray, num_higher: int
) -> Gaussians:
    """Make round Gaussians at ``depths [n]`` along ``rays [n,3]``, ``size`` large at depth 1, of ``colors [n,3]``."""
    return Gaussians(
        means=(eye + depths[:, None] * rays).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (len(rays), 1)),
        scales=np.repeat((size * depths)[:, None], 3, 1).astype(np.float32),
        opacities=np.full(len(rays), OPACITY, np.float32),
        sh0=rgb_to_sh0(colors)[:, None].astype(np.float32),
        shN=np.zeros((len(rays), num_higher, 3), np.float32),
    )


def _agreeing(scene: PicturedScene, view: int, holes: np.ndarray, rays: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Choose one of ``depths [d,n]`` along each of ``rays [n,3]``: where the nearest other views show the same colour.

    The differences of colours are averaged over the ``holes [h,w]`` around. In doubt it is the first depth.
    """
    cameras, centres = scene.cameras, scene.cameras.centres
    others = [other for other in nearest_views(centres, view) if (centres[other] != centres[view]).any()][:OTHERS]
    moves = []
    for other in others:
        K, (turn, shift) = cameras.Ks[other], np.split(cameras.viewmats[other, :3], [3], 1)
        start = matmul(K, matmul(turn, centres[view]) + shift[:, 0])
        along = np.ascontiguousarray(matmul(matmul(rays, turn.T), K.T).T)
        moves.append((scene.images[other], along, start))
    colors, pixels = scene.images[view][holes], np.flatnonzero(holes)
    chosen, least = depths[0], np.full(len(rays), np.inf, np.float32)
    for step, depth in enumerate(depths):
        sums = np.zeros((*holes.shape, 2), np.float32)  # of differences, and their number
        for picture, along, start in moves:
            add_differences(picture, along, start, depth, colors, pixels, sums)
        total, number = blur(sums, BLUR).reshape(-1, 2)[pixels].T
        cost = np.where(number > LEAST, total / np.maximum(number, LEAST), np.inf) + FARTHER * step
        chosen, least = np.where(cost < least, depth, chosen), np.minimum(cost, least)
    return chosen
