"""Groups and unaligned Gaussians -> members: the pixel that each Gaussian belongs to.

A Gaussian belongs to the superpixel, of all views, that gets most of its blending weights (paper,
supplement "Compaction of Non-Pixel-Aligned FF Backbones"). Gaussians that no view sees are marked.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from threading import Lock

import numpy as np

from gsmerge.errors import UsageError
from gsmerge.geometry import morton_codes
from gsmerge.kernels.raster.contribution import dominant_labels
from gsmerge.pooling import Members, pool_members, scene_members, unaligned_members
from gsmerge.raster import TiledView
from gsmerge.raster.images import ONE_AT_A_TIME, tile_views
from gsmerge.raster.photos import NEAR_PLANE
from gsmerge.runtime.record import stage
from gsmerge.runtime.threads import in_turn, parallel_map
from gsmerge.settings.stages import DecodeOptions
from gsmerge.stages.decode import decode
from gsmerge.stages.encode import from_moments
from gsmerge.types import Gaussians, Groups, Scene

# Share of pixels with a centre: of captures in voxels six with .97 and more gain by projection, two with .93 and .95
# lose 1.5 and 5 dB
MIN_WITH_CENTRE = 0.96


@stage("members")
def assign(scene: Scene, groups: Groups, *, draws: bool = True) -> Members:
    """Return all Gaussians of a canonical scene as members with a pixel each; UsageError if no view sees any.

    ``draws``: draw every view to assign Gaussians without pixels. Otherwise their centres are projected, which is
    faster, suits networks better, and shows which Gaussian each pixel sees; it fails to cover the views if centres are
    far apart.
    """
    if scene.aligned:
        return scene_members(scene)
    pixels, fronts = (None, None) if draws else find_pixels(scene)
    if pixels is None or fronts is None or (fronts >= 0).mean() < MIN_WITH_CENTRE:
        pixels, fronts = owner_pixels(find_owners(scene, groups), groups), None
    if not (pixels >= 0).any():
        raise UsageError(
            f"expected views that see the scene, found that none of {len(scene)} sees any of {len(pixels)} Gaussians: "
            "give the cameras that belong to it"
        )
    return unaligned_members(scene, pixels, fronts)


def find_pixels(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Find the pixel of each Gaussian, ``[n]`` int64 over all views, and the front of each pixel, ``[v,h,w]`` int32.

    A Gaussian's pixel is the one with the largest opacity x transmittance x area, pixels, or -1 if no view sees it; in
    ties the first view counts. The front of a pixel is the Gaussian with the largest opacity x transmittance among
    those with their centre in it, or -1 without any.
    """
    from gsmerge.kernels.gaussians.fronts import weigh_centres  # with networks alone

    g, cameras, count = scene.gaussians, scene.cameras, len(scene)
    means, scales, opacities = (np.ascontiguousarray(column, np.float32) for column in (g.means, g.scales, g.opacities))
    viewmats, Ks = (np.ascontiguousarray(array, np.float64) for array in (cameras.viewmats, cameras.Ks))
    fronts = np.empty((count, cameras.height, cameras.width), np.int32)
    most, pixels = np.zeros(len(g), np.float32), np.full(len(g), -1, np.int64)

    def weigh(view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return weigh_centres(means, scales, opacities, viewmats[view], Ks[view], NEAR_PLANE, fronts[view])

    of_views = in_turn(weigh, range(count)) if len(g) <= ONE_AT_A_TIME else map(weigh, range(count))
    for view, (ids, places, weights) in enumerate(of_views):
        better = weights > most[ids]
        ids = ids[better]
        most[ids], pixels[ids] = weights[better], view * scene.pixels_per_view + places[better]
    return pixels, fronts


def merge_unseen(gaussians: Gaussians, scene: Scene, count: int) -> Gaussians:
    """Merge n Gaussians that no view sees into ``count``, by runs along Morton's curve."""
    order = np.argsort(morton_codes(gaussians.means.astype(np.float64)), kind="stable")
    members = unaligned_members(replace(scene, gaussians=gaussians), np.full(len(gaussians), -1, np.int64))
    starts = np.linspace(0, len(order), count + 1).astype(np.int64)
    features = from_moments(pool_members(members, starts, order), starts, order, np.full(count, -1))
    return decode(features, members, DecodeOptions(min_opacity=0.0))


@dataclass(frozen=True)
class Owners:
    """The superpixel to which each of n Gaussians contributes most."""

    values: np.ndarray  # [n] float32 blending weights summed over the superpixel, pixels; or 0
    views: np.ndarray  # [n] int32, -1 if unseen
    labels: np.ndarray  # [n] int32 superpixel within the view, -1 if unseen


def find_owners(scene: Scene, groups: Groups) -> Owners:
    """Find the superpixel to which each Gaussian contributes most, over all views; in ties the first view counts."""
    count, lock = len(scene.gaussians), Lock()
    best = Owners(np.zeros(count, np.float32), np.full(count, -1, np.int32), np.full(count, -1, np.int32))

    def one_view(view: int, tiled: TiledView) -> None:
        values, labels = view_owners(tiled, groups.labels[view], groups.counts[view])
        with lock:
            old, first = best.values[tiled.ids], best.views[tiled.ids]
            better = (values > old) | ((values == old) & (labels >= 0) & (view < first))
            ids = tiled.ids[better]
            best.values[ids], best.views[ids], best.labels[ids] = values[better], view, labels[better]

    tile_views(scene, one_view)
    return best


def view_owners(tiled: TiledView, labels: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return each Gaussian's largest contribution ``[m]`` to a superpixel of one view, and that superpixel ``[m]``."""
    labels = np.ascontiguousarray(labels, np.int32)
    return dominant_labels(*tiled.lists, labels, count)


def owner_pixels(owners: Owners, groups: Groups) -> np.ndarray:
    """Return the middle pixel of each Gaussian's superpixel, ``[n]`` int64 over all views, -1 if unseen."""
    counts = np.asarray(groups.counts)
    size, first = groups.labels[0].size, np.cumsum(counts) - counts

    def one_view(view: int) -> np.ndarray:
        return middle_pixels(groups.labels[view], groups.counts[view]) + view * size

    middles = np.concatenate(parallel_map(one_view, range(len(counts))))
    return np.where(owners.labels >= 0, middles[first[owners.views] + owners.labels], -1)


def middle_pixels(labels: np.ndarray, count: int) -> np.ndarray:
    """Return the pixel ``[count]`` int64 nearest to the centroid of each superpixel; 0 for an empty one."""
    height, width = labels.shape
    flat = labels.reshape(-1)
    y, x = np.divmod(np.arange(height * width), width)
    sizes = np.maximum(np.bincount(flat, minlength=count), 1)
    dy, dx = (axis - (np.bincount(flat, axis, count) / sizes)[flat] for axis in (y, x))
    away, least = dx * dx + dy * dy, np.full(count, np.inf)
    np.minimum.at(least, flat, away)
    nearest = np.flatnonzero(away == least[flat])[::-1]  # the first pixel of equal ones is written last
    middles = np.zeros(count, np.int64)
    middles[flat[nearest]] = nearest
    return middles
