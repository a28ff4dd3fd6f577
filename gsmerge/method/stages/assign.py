"""Groups and Gaussians -> members: find the pixel to which each Gaussian belongs, if a view sees the Gaussian."""

from __future__ import annotations

from threading import Lock

import numpy as np

from gsmerge.errors import UsageError
from gsmerge.frozen import dataclass, replace
from gsmerge.method.geometry.pooling import Members, scene_members
from gsmerge.method.kernels.raster.contribution import dominant_labels
from gsmerge.method.raster import TiledView
from gsmerge.method.raster.images import tile_views
from gsmerge.runtime.record import stage
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Groups, Scene


@stage("members")
def assign(scene: Scene, groups: Groups, *, by_contribution: bool = False) -> Members:
    """Return all Gaussians of a canonical scene as members of superpixels, each with its pixel.

    A Gaussian belongs to the superpixel of its pixel. If Gaussians belong to no pixels, ``by_contribution`` assigns
    each Gaussian to the superpixel, of any view, in which the sum of its blending weights is largest (paper, supplement
    "Compaction of Non-Pixel-Aligned FF Backbones"). Every view is drawn to measure the sums of blending weights. Raises
    UsageError if no view sees any Gaussian.
    """
    members = scene_members(scene)
    if by_contribution and not scene.has_own_pixels:
        members = replace(members, pixels=owner_pixels(find_owners(scene, groups), groups))
    if not (members.pixels >= 0).any():
        raise UsageError(
            f"expected views that see the scene, found that none of {len(scene)} sees any of {len(members.pixels)}"
            " Gaussians: give the cameras that belong to it"
        )
    return members


@dataclass(frozen=True, eq=False)
class Owners:
    """Superpixels to which n Gaussians contribute most, one for each Gaussian."""

    values: np.ndarray  # [n] float32, blending weights summed over the superpixel, in pixels; 0 if unseen
    views: np.ndarray  # [n] int32, view of the superpixel; -1 if unseen
    labels: np.ndarray  # [n] int32, superpixel within the view; -1 if unseen


def find_owners(scene: Scene, groups: Groups) -> Owners:
    """Find, in all views, the superpixel to which each Gaussian contributes most.

    If a Gaussian contributes equally to superpixels of several views, the first view counts.
    """
    count = len(scene.gaussians)
    lock = Lock()
    best = Owners(np.zeros(count, np.float32), np.full(count, -1, np.int32), np.full(count, -1, np.int32))

    def update_best(view: int, tiled: TiledView) -> None:
        """Replace entries of ``best`` by superpixels of this view with larger contributions."""
        view_labels = np.ascontiguousarray(groups.labels[view], np.int32)
        values, labels = dominant_labels(*tiled.lists, view_labels, groups.counts[view])
        with lock:
            best_values = best.values[tiled.ids]
            best_views = best.views[tiled.ids]
            is_better = (values > best_values) | ((values == best_values) & (labels >= 0) & (view < best_views))
            ids = tiled.ids[is_better]
            best.values[ids], best.views[ids], best.labels[ids] = values[is_better], view, labels[is_better]

    tile_views(scene.gaussians, scene.cameras, update_best)
    return best


def owner_pixels(owners: Owners, groups: Groups) -> np.ndarray:
    """Return the middle pixel ``[n]`` int64 of the superpixel of each Gaussian, or -1 if no view sees the Gaussian.

    Pixels are numbered through all views.
    """
    counts = np.asarray(groups.counts)
    pixels_per_view, offsets = groups.labels[0].size, np.cumsum(counts) - counts

    def view_middles(view: int) -> np.ndarray:
        """Return the middle pixels of the superpixels of one view."""
        return middle_pixels(groups.labels[view], groups.counts[view]) + view * pixels_per_view

    middles = np.concatenate(parallel_map(view_middles, range(len(counts))))
    return np.where(owners.labels >= 0, middles[offsets[owners.views] + owners.labels], -1)


def middle_pixels(labels: np.ndarray, count: int) -> np.ndarray:
    """Return the pixel ``[count]`` int64 nearest to the centroid of each superpixel, or 0 if it is empty."""
    height, width = labels.shape
    flat = labels.reshape(-1)
    y, x = np.divmod(np.arange(height * width), width)
    sizes = np.maximum(np.bincount(flat, minlength=count), 1)
    dy, dx = (axis - (np.bincount(flat, axis, count) / sizes)[flat] for axis in (y, x))
    squares = dx * dx + dy * dy
    min_squares = np.full(count, np.inf)
    np.minimum.at(min_squares, flat, squares)
    # The pixels are in descending order, so that of equally near pixels the first one overwrites the others
    nearest = np.flatnonzero(squares == min_squares[flat])[::-1]
    middles = np.zeros(count, np.int64)
    middles[flat[nearest]] = nearest
    return middles
