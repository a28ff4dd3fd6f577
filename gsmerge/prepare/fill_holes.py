"""Fill the holes of an export: add Gaussians at pixels that no Gaussian covers.

Exporters drop borders, far regions and faint rows, and voxels have gaps. Each view is drawn from its own camera. Each
empty pixel of the drawing gets a Gaussian with the colour of the picture. The new Gaussian gets the depth of the view's
depth map, if the model wrote one. Otherwise it gets the depth of the surface beside the pixel, or a depth beyond the
view's farthest surface: the one at which the pictures of the nearest other views agree best.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.method.geometry.gaps import fill_gaps
from gsmerge.method.geometry.pixel_gaussians import NEW_SIZE_PIXELS, make_round_gaussians, pixel_rays
from gsmerge.method.geometry.transforms import camera_depths, lies_inside, median, nearest_views, quantiles
from gsmerge.method.kernels.matrices import matmul
from gsmerge.method.kernels.pictures import blur
from gsmerge.method.kernels.reproject import add_differences
from gsmerge.method.raster import TiledView
from gsmerge.method.raster.composite import blend_depths, find_covered
from gsmerge.method.raster.images import thin_out, tile_views, tiles_near
from gsmerge.prepare.photo_change import PhotoChange, change_large
from gsmerge.runtime.record import list_some, note
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Gaussians, PicturedScene

# The numbers from HOLE_OPACITY to BARE were chosen on exports of eight captures as Depth Anything 3 writes them, and on
# the same exports with shuffled and with merged rows
HOLE_OPACITY = 0.75  # opacity of the drawing below which a pixel is empty
# NOTHING and SPARSE are shares of the usual opacity of a view, which is low if the export has few rows. A pixel shows
# nothing if its opacity is below the share NOTHING. A pixel is in an empty part if it shows nothing, and if the mean
# opacity around it is below the share SPARSE
NOTHING = 0.5
SPARSE = 0.25
# A part of a picture stays empty if a square with the side LARGE_SIDE, a share of the picture's longer side, fits into
# the part. All squares that fit must together cover at least the share LARGE_AREA of the picture. A rim of RIM_PIXELS
# pixels is taken off each empty part
LARGE_SIDE = 1 / 12
LARGE_AREA = 0.12
RIM_PIXELS = 2
GAP_WIDTH = 1 / 53  # beside large empty parts, only gaps narrower than this share of the longer side are filled
MOST_EMPTY = 0.5  # from this share of empty pixels on, the scene may be only a part of what the photos show
FACTORS = 2.0 ** np.linspace(0, 3, 13)  # candidate depths, relative to the depth of a view's farthest surface
FARTHEST_QUANTILE = 0.99  # quantile of the depths that counts as the farthest
HOLE_NEIGHBORS = 3  # number of nearest views that a picture is compared with
DIFFERENCE_BLUR = 3.0  # standard deviation in pixels of the window over which differences are averaged
SAMPLE = 10_000  # pixels of a view that are enough for medians of depths; few Gaussians are all used
DRAWN_OF = 4  # Gaussians of which one is drawn, enlarged, to find out whether a pixel whose depth is known is covered
BARE = 0.02  # opacity up to which the Gaussian of a pixel shows nothing


def fill_holes(scene: PicturedScene, shown: np.ndarray, *, everywhere: bool = False) -> PicturedScene:
    """Add a Gaussian at each pixel of a canonical scene that no Gaussian covers, except in large empty parts.

    ``shown [v,h,w]`` marks pixels with a usable picture. The new Gaussians come after the others. No Gaussian is added
    if most of the pixels are empty, because photos may show more than the scene. Large connected parts of a view
    without Gaussians stay empty, because the scene may have been cut out, or its model may have left out the sky. With
    ``everywhere``, large empty parts are filled, too. In a cropped scene, all pixels without Gaussians stay empty.
    A note says what stays empty.
    """
    found = _find_holes(scene, shown, everywhere=everywhere)
    if found is None:
        return scene
    views, holes, empty, edges = found.views, found.holes, found.empty, found.edges
    refused = [scene.names[view] for view in sorted(edges) if edges[view].known is None]
    if scene.depths is not None and refused:
        why = "the depths of their views' Gaussians do not confirm them"
        note(f"the depth maps of {len(refused)} of {len(scene)} views are not used: {why} ({list_some(refused)})")
    if edges and np.count_nonzero(found.bare[views]) < MOST_EMPTY * np.count_nonzero(~empty[views]):
        ids = sorted(edges)
        added = Gaussians.concat(parallel_map(lambda view: _fill_view(scene, view, holes[view], edges[view]), ids))
        holes[[view for view in range(len(scene)) if view not in edges]] = False
        pixels = np.flatnonzero(holes)
        if scene.region is not None:
            inside = lies_inside(scene.region, added.means)
            added = added[inside]
            pixels = pixels[inside]
        scene = fill_pixels(scene, added, pixels)
    return _leave_empty(scene, empty)


@dataclass(frozen=True, eq=False)
class _Edges:
    """Depths in a view around its n holes."""

    beside: np.ndarray  # [n] depth of the surface beside each hole, or in it if a depth map knows all holes
    farthest: float  # Depth of the view's farthest surface
    known: np.ndarray | None = None  # [n] depth of each hole in the view's depth map, NaN without one


@dataclass(frozen=True, eq=False)
class _Holes:
    """What is missing in the views of a scene."""

    views: list[int]  # views with pixels that may be filled, or with large empty parts
    bare: np.ndarray  # [v,h,w] bool, other pixels of these views that no Gaussian covers enough
    holes: np.ndarray  # [v,h,w] bool, those of them that can be filled
    empty: np.ndarray  # [v,h,w] bool, pixels that stay empty
    edges: dict[int, _Edges]  # of the views with holes


def _find_holes(scene: PicturedScene, shown: np.ndarray, *, everywhere: bool) -> _Holes | None:
    """Find the holes of all views, and the parts that stay empty; see :func:`fill_holes`. None if there are none."""
    fronts = scene.get_pixels().fronts
    is_cropped = scene.region is not None
    beyond = scene.beyond
    fillable = shown & (fronts < 0)  # pixels with a picture and without a Gaussian
    bare = find_bare(scene)
    has_empty = np.array([is_cropped or (not everywhere and large_parts(part).any()) for part in bare])
    views = [view for view in range(len(scene)) if has_empty[view] or fillable[view].any()]
    if not views:
        return None
    holes, empty, edges = np.zeros_like(fillable), np.zeros_like(fillable), dict[int, _Edges]()
    gap = 2 * round(GAP_WIDTH * max(shown.shape[1:]) / 2) + 1
    # Where each pixel has its own Gaussians, a view without an empty part needs to be drawn only at its holes, and
    # around them if the depth beside them counts. A view of few Gaussians does not know its farthest surface
    around = gap if scene.depths is None else 0
    knows = scene.has_own_pixels & ~has_empty & (fillable.mean((1, 2)) < MOST_EMPTY)
    parts = {view: tiles_near(fillable[view], around) for view in views if knows[view]}
    num_own = np.count_nonzero(fronts >= 0, axis=(1, 2))
    known_views = _find_known(scene, parts, fillable, holes, edges)
    bare[known_views] = holes[known_views]

    def find_holes(view: int, tiled: TiledView) -> None:
        """Mark a view's pixels that stay empty, other pixels that its drawing does not cover, and holes to fill."""
        depths, transmittance = blend_depths(tiled)
        covered = transmittance <= 1 - HOLE_OPACITY
        if view in parts:
            bare[view] = fillable[view] & ~covered
        else:
            if is_cropped or not everywhere:
                empty[view] = _find_empty(1 - transmittance, shown[view], gap, is_cropped=is_cropped)
            if beyond is not None:  # nothing is known there
                empty[view] &= ~beyond[view]
            bare[view] = ~covered & ~empty[view]
        holes[view] = fillable[view] & bare[view]
        if empty[view].any():  # the edges of a scene that was cut out are no holes
            window = np.ones((gap, gap), np.uint8)
            holes[view] &= cv2.morphologyEx(covered.astype(np.uint8), cv2.MORPH_CLOSE, window) > 0
        if covered.any() and holes[view].any():
            pixels, own_depths = _sample_own(scene, view)
            beside = fill_gaps(depths[..., None], covered)[..., 0]
            if 2 * num_own[view] < np.count_nonzero(covered):  # the view has lost its rows, and other views know more
                pixels = np.flatnonzero(covered)
                pixels = pixels[:: 1 + len(pixels) // SAMPLE]
                own_depths = depths.reshape(-1)[pixels].astype(np.float64)
            known = _fit_map(scene, view, pixels, own_depths)
            surfaces = own_depths if view in parts and own_depths.size else depths[covered]
            (farthest,) = quantiles(surfaces, [FARTHEST_QUANTILE])
            edges[view] = _Edges(beside[holes[view]], float(farthest), None if known is None else known[holes[view]])

    tile_views(scene.gaussians, scene.cameras, find_holes, sorted({*views} - {*known_views}), parts)
    return _Holes(views, bare, holes, empty, edges)


def _find_known(
    scene: PicturedScene,
    parts: Mapping[int, np.ndarray],
    fillable: np.ndarray,
    holes: np.ndarray,
    edges: dict[int, _Edges],
) -> list[int]:
    """Find the holes of views whose depth maps know the depths of all pixels that may be filled; return these views.

    As no depth beside a hole counts, a sample of the Gaussians is drawn, and only the tiles ``parts`` of a view.
    ``fillable [v,h,w]`` marks pixels that may be filled. The result is written to ``holes [v,h,w]`` and ``edges``.
    """
    if scene.depths is None:
        return []
    fronts = scene.get_pixels().fronts
    known = dict[int, tuple[np.ndarray, float]]()  # depths of a view's pixels that may be filled, and the farthest
    for view in parts:
        if 2 * np.count_nonzero(fronts[view] >= 0) < fronts[view].size:
            continue
        pixels, own_depths = _sample_own(scene, view)
        depths = _fit_map(scene, view, pixels, own_depths)
        if depths is None:
            continue
        (farthest,) = quantiles(own_depths, [FARTHEST_QUANTILE])
        if np.isfinite(depths[fillable[view]]).all():
            known[view] = depths[fillable[view]], float(farthest)

    def find_holes(view: int, tiled: TiledView) -> None:
        """Mark the pixels of a view that the sample does not cover, with their depths."""
        is_hole = ~find_covered(tiled, 1 - HOLE_OPACITY)[fillable[view]]
        holes[view, fillable[view]] = is_hole
        if is_hole.any():
            depths, farthest = known[view]
            edges[view] = _Edges(depths[is_hole], farthest, depths[is_hole])

    sample = thin_out(scene.gaussians, max(1, len(scene.gaussians) // DRAWN_OF))
    tile_views(sample, scene.cameras, find_holes, list(known), parts)
    return list(known)


def fill_pixels(scene: PicturedScene, added: Gaussians, empty_pixels: np.ndarray) -> PicturedScene:
    """Add Gaussians to a scene that fill holes, each in an empty pixel.

    ``empty_pixels [n]`` has the pixel of each added Gaussian, numbered over all views.
    """
    count = len(scene.gaussians)
    old_pixels = scene.get_pixels()
    homes = old_pixels.homes
    fronts = old_pixels.fronts.copy()
    fronts.reshape(-1)[empty_pixels] = np.arange(count, count + len(added), dtype=np.int32)
    pixels = replace(old_pixels, homes=np.concatenate([homes, empty_pixels.astype(homes.dtype)]), fronts=fronts)
    filled = np.zeros(count, bool) if scene.filled is None else scene.filled
    filled = np.concatenate([filled, np.ones(len(added), bool)])
    return replace(scene, gaussians=Gaussians.concat([scene.gaussians, added]), pixels=pixels, filled=filled)


def find_bare(scene: PicturedScene) -> np.ndarray:
    """Return a mask ``[v,h,w]`` of pixels that seem to show nothing: no Gaussian is in front, or a faint one."""
    fronts = scene.get_pixels().fronts
    return np.asarray((fronts < 0) | (scene.gaussians.opacities[fronts] <= BARE))


def _find_empty(opacity: np.ndarray, shown: np.ndarray, gap: int, *, is_cropped: bool) -> np.ndarray:
    """Find the pixels ``[h,w]`` of a view that stay empty, from the ``opacity [h,w]`` of its drawing.

    ``shown [h,w]`` marks pixels with a usable picture, and ``gap`` is the width in pixels up to which gaps are filled.
    """
    usual = usual_opacity(opacity)
    nothing = opacity < NOTHING * usual
    if is_cropped:
        beside = np.ones((3, 3), np.uint8)  # a Gaussian never ends exactly between two pixels
        return np.asarray(cv2.erode((nothing & ~shown).astype(np.uint8), beside) > 0)
    sparse = blur(opacity, gap / 4) < SPARSE * usual  # edges of a scene that was cut out are not sparse
    return large_parts(nothing & sparse)


def usual_opacity(opacity: np.ndarray) -> float:
    """Return the mean of a picture's opacities, weighted by themselves, so that empty pixels do not count."""
    return float((opacity * opacity).sum() / max(float(opacity.sum()), 1e-6))


def _sample_own(scene: PicturedScene, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels ``[p]`` of a view that have a Gaussian, at most about SAMPLE, and the depths ``[p]`` of these."""
    fronts = scene.get_pixels().fronts[view].reshape(-1)
    pixels = np.flatnonzero(fronts >= 0)
    pixels = pixels[:: 1 + len(pixels) // SAMPLE]
    means = scene.gaussians.means[fronts[pixels]].astype(np.float64)
    return pixels, camera_depths(means, scene.cameras.viewmats[view])


def _fit_map(scene: PicturedScene, view: int, pixels: np.ndarray, own_depths: np.ndarray) -> np.ndarray | None:
    """Bring a view's depth map to the unit of the scene; return ``[h,w]``, NaN where it has no depth.

    None without a map, or if the map explains the ``own_depths [p]`` of Gaussians at ``pixels [p]`` no better than one
    depth for all of them does: it does not belong to the view.
    """
    if scene.depths is None:
        return None
    known = scene.depths[view].astype(np.float64)
    known[~(np.isfinite(known) & (known > 0))] = np.nan
    sample = known.reshape(-1)[pixels]
    both = np.isfinite(sample)
    if not both.any():
        return None
    depths = own_depths[both]
    ratios = depths / sample[both]
    usual = median(depths)
    unit = median(ratios)
    explains = median(np.abs(ratios / unit - 1)) < median(np.abs(depths / usual - 1))
    return known * unit if explains else None


def large_parts(empty: np.ndarray) -> np.ndarray:
    """Return a mask ``[h,w]`` of the connected parts of ``empty [h,w]`` that hold a large square, without their rim.

    Gaps, and the borders that exporters leave out, are narrower than a large square. The mask has no pixel if all
    squares together cover less than ``LARGE_AREA``. Depth Anything 3 leaves out a tenth of the pixels, which is less
    than ``LARGE_AREA``.
    """
    if empty.mean() < LARGE_AREA:
        return np.zeros_like(empty)
    side = 2 * round(LARGE_SIDE * max(empty.shape) / 2) + 1
    square = np.ones((side, side), np.uint8)
    rim = np.ones((2 * RIM_PIXELS + 1,) * 2, np.uint8)
    opened = cv2.morphologyEx(empty.astype(np.uint8), cv2.MORPH_OPEN, square) > 0
    if opened.mean() < LARGE_AREA:
        return np.zeros_like(empty)
    _, labels = cv2.connectedComponents(empty.astype(np.uint8), connectivity=4)
    is_large = np.isin(labels, labels[opened & empty])
    return np.asarray(cv2.erode(is_large.astype(np.uint8), rim) > 0)


def _leave_empty(scene: PicturedScene, empty: np.ndarray) -> PicturedScene:
    """Return a scene whose pictures are black, and do not count in scores, at pixels that stay ``empty [v,h,w]``.

    A note says what share of the pixels no longer counts.
    """
    if not empty.any() or empty.all():
        return scene
    counted = empty if scene.masks is None else empty & scene.masks
    share = round(100 * float(counted.mean()))
    if share:
        views = int(counted.any((1, 2)).sum())
        note(
            f"the scene shows nothing in large parts of {views} of {len(empty)} views, {share} % of all pixels;"
            " these parts stay empty, and photos do not count there; --set extent=photos fills them"
        )
    images = np.where(empty[..., None], np.float32(0), scene.images)
    masks = ~empty if scene.masks is None else scene.masks & ~empty
    large = scene.large_photos
    shares = empty.astype(np.float32) if scene.empty is None else np.maximum(scene.empty, empty)
    if large is not None:
        black = np.zeros((*empty.shape[1:], 3), np.float32)
        large = change_large(large, [PhotoChange(cover=mask, colors=black) for mask in empty])
    return replace(scene, images=images, masks=masks, large_photos=large, empty=shares)


def _fill_view(scene: PicturedScene, view: int, holes: np.ndarray, edges: _Edges) -> Gaussians:
    """Make a Gaussian for each pixel of a view in the mask ``holes [h,w]``, with the depth of the map if it has one."""
    cameras = scene.cameras
    rays = pixel_rays(holes, cameras.Ks[view], cameras.viewmats[view])
    known = np.full(len(rays), np.nan) if edges.known is None else np.minimum(edges.known, edges.farthest * FACTORS[-1])
    is_known = np.isfinite(known)
    depths = known if is_known.all() else np.where(is_known, known, _search_depths(scene, view, holes, edges, rays))
    size = NEW_SIZE_PIXELS / cameras.Ks[view, 0, 0]
    colors = scene.images[view][holes]
    num_higher = scene.gaussians.shN.shape[1]
    return make_round_gaussians(
        cameras.centres[view], rays, depths=depths, size=size, colors=colors, num_higher=num_higher
    )


def _search_depths(scene: PicturedScene, view: int, holes: np.ndarray, edges: _Edges, rays: np.ndarray) -> np.ndarray:
    """Choose for each hole, with ``rays [n,3]``, the depth at which the nearest other views show the same colour.

    Differences of colours are averaged over neighbouring holes. If no other view sees the points of a ray, the depth of
    the surface beside the hole is chosen.
    """
    cameras = scene.cameras
    centres = cameras.centres
    eye = centres[view]
    edge_depths = edges.beside.astype(np.float64)
    far_depths = edges.farthest * FACTORS[:, None]
    depths = np.concatenate([edge_depths[None], np.maximum(far_depths, edge_depths)])  # [d,n] candidates
    # the point of a ray at a depth has the homogeneous pixel `start + depth * along` in another view
    neighbors = [i for i in nearest_views(centres, view) if (centres[i] != eye).any()][:HOLE_NEIGHBORS]
    projected = []
    for neighbor in neighbors:
        K = cameras.Ks[neighbor]
        rotation, translation = np.split(cameras.viewmats[neighbor, :3], [3], 1)
        start = matmul(K, matmul(rotation, eye) + translation[:, 0])
        projected.append((start, np.ascontiguousarray(matmul(matmul(rays, rotation.T), K.T).T)))
    colors = scene.images[view][holes]
    pixels = np.flatnonzero(holes)
    best_depths = depths[0]
    best_costs = np.full(len(rays), np.inf, np.float32)
    min_gain = 0.001  # decrease in the difference of colours (sRGB) that each step to a farther depth has to bring
    min_weight = 1e-3  # least weight, in the window of DIFFERENCE_BLUR, of pixels that other views see
    for step, depth in enumerate(depths):
        sums = np.zeros((*holes.shape, 2), np.float32)  # sums of differences, and numbers of differences
        for neighbor, (start, along) in zip(neighbors, projected, strict=True):
            add_differences(scene.images[neighbor], along, start, depth, colors, pixels, sums)
        total, number = blur(sums, DIFFERENCE_BLUR).reshape(-1, 2)[pixels].T
        cost = np.where(number > min_weight, total / np.maximum(number, min_weight), np.inf) + min_gain * step
        best_depths = np.where(cost < best_costs, depth, best_depths)
        best_costs = np.minimum(cost, best_costs)
    return best_depths
