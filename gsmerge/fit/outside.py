"""Views from outside of the capture, from which a fit removes fog and veils.

Photos do not show the space between them or in front of other cameras, and a fit fills it with large Gaussians. To a
viewer who steps back, they are fog where the input is empty, and veils in front of what it shows. So some steps of a
fit draw views from behind, beside, above and below, and compare opacities and depths with those of the input.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from gsmerge.geometry import depths_inside, is_inside, middle_depth, project, step_outside
from gsmerge.kernels.raster.project import TILE
from gsmerge.raster import Splats, make_splats, tile_view
from gsmerge.raster.composite import blend, blend_depths, depth_colors
from gsmerge.raster.gradient import Gradients, gradients_of
from gsmerge.raster.photos import Photos, blank_photos
from gsmerge.raster.tiled_view import TiledView
from gsmerge.runtime.threads import in_turn
from gsmerge.settings.fit import FitOptions
from gsmerge.types import Cameras, Gaussians, Scene

# Least and largest step back, as a share of the depth of what a view shows, and rotations about its middle to the
# sides, and up or down, degrees. Without a step back the cameras would see the same as new views, in which a fit has to
# fill gaps
LOW, HIGH = (0.4, -35.0, -25.0), (1.6, 35.0, 25.0)
# Steps of three numbers, modulo one, that fill a cube evenly, whatever their number (the R sequence of Roberts 2018)
EVEN = np.array([0.8191725134, 0.6710436067, 0.5497004779])
PLACES = 42  # views from outside, at most, or the number of photos if that is more
SAMPLE = 2000  # Gaussians that measure how far away the middle of a view is
# Gaussians for each photo, of at most PLACES photos, that stand for the whole input. They are made larger the fewer
# they are, since a picture has the same number of pixels, however many photos there are
ROWS = 4000
NEAREST = 0.25  # near plane, as a share of the depth of what a view shows
# Depths from FARTHEST times the quantile LAST on count as that, since a flyaway moves the mean depth of its pixels
LAST, FARTHEST = 0.98, 4.0
EMPTY, SOLID = 0.15, 0.9  # opacities of the input below which a pixel is empty, and above which it shows a surface
# Distance from what the input shows, as a share of the width, within which pixels do not count: what stands beside an
# outline fills what the foreground uncovers in new views
RIM = 0.04
MARGIN = 0.15  # share of a surface's depth by which the mean depth of a pixel may be less before it counts as veiled
# Gaussians of the start for each photo from which on fog weighs as much as errors of the photos. Fewer ones are larger
# and reach from the borders of photos into empty space, and would leave both. LIGHT is the least weight of fog, VEIL
# the weight of veils in units of that of fog
MANY, LIGHT, VEIL = 1000, 0.15, 30
LEVEL = 3  # size of a picture's pixels in pixels of the photo; at 2 fog is as thin, at 4 it is a fifth thicker
LEAST_WIDTH = 64  # least width of the pictures, pixels
LEAST = 0.005  # share of a picture that must be empty or solid for the picture to count
TOUCHED = 1e-9  # gradient of the opacity from which on a Gaussian takes part in a step
SCORED = 12  # views, at most, in which the fog of a result is measured


@dataclass(frozen=True, eq=False)
class Outside:
    """Views from outside, and the depth of what the input shows in each pixel."""

    views: Photos  # Black pictures; weights [v,h,w] are 0 for pixels that do not count
    # [v,h,w] camera z before which nothing should stand: infinite where the input is empty, 0 where anything may stand
    limits: np.ndarray
    near: np.ndarray  # [v] camera z of the near plane
    far: np.ndarray  # [v] camera z that what is farther is given

    def contradict(self, points: np.ndarray, share: float) -> np.ndarray:
        """Return a mask ``[n]`` of points ``[n,3]`` that stand before a ``share`` of the limit in some view."""
        cameras = Cameras(self.views.viewmats, self.views.Ks, self.views.width, self.views.height)
        pixels, z = project(points, cameras)
        inside = (z > self.near[:, None]) & is_inside(pixels, cameras)
        view, point = np.nonzero(inside)
        column, row = pixels[inside].astype(np.int64).T
        wrong = z[inside] < share * self.limits[view, row, column]
        return np.bincount(point[wrong], minlength=len(points)) > 0


def place_outside_views(scene: Scene, start: Gaussians, photos: Photos, options: FitOptions) -> Outside | None:
    """Place views outside of the capture for a fit from a ``start``, and draw the scene in them to find their limits.

    Cameras step back from those of ``photos``. Pictures are a third as large, at least ``LEAST_WIDTH`` wide. A scene
    without Gaussians, as when blocks are joined, is replaced by the start. Returns None if no step draws such a view,
    or if too few pixels of each would count.
    """
    num_steps = math.ceil(options.steps * (1 - options.tuning.outside_from) / options.tuning.outside_every)
    if num_steps == 0:
        return None
    rows = _sample(scene, ROWS * min(len(photos), PLACES)) if len(scene.gaussians) else start
    if len(rows) == 0 or len(photos) == 0:
        return None
    cameras = Cameras(photos.viewmats, photos.Ks, photos.width, photos.height)
    points = rows.means[:: max(1, len(rows) // SAMPLE)]
    placed = outside_cameras(points, cameras, min(num_steps, max(PLACES, len(photos))), LOW, HIGH)
    depths = [depths_inside(points, cameras[[view]]) for view in range(min(len(placed), len(cameras)))]
    near, far = np.resize([np.quantile(of_view, (0.5, LAST)) for of_view in depths], (len(placed), 2)).T
    near, far = NEAREST * near, FARTHEST * far
    views, drawn = blank_photos(placed, min(LEVEL, photos.width / LEAST_WIDTH)), make_splats(rows)

    def find_limits(view: int) -> np.ndarray:
        depths, left = blend_depths(_tile(drawn, views, view, near[view]), far[view])
        opacities = 1 - left
        return np.where(mark_empty(opacities), np.inf, np.where(opacities > SOLID, depths, 0)).astype(np.float32)

    limits = np.stack(list(in_turn(find_limits, range(len(views)))))
    weight = np.float32(np.clip(len(start) / (MANY * len(photos)), LIGHT, 1.0))
    weights = weight * np.where(np.isinf(limits), 1, np.where(limits > 0, VEIL, 0)).astype(np.float32)
    ids = np.flatnonzero((limits > 0).mean((1, 2)) > LEAST).tolist()
    return Outside(replace(views[ids], weights=weights[ids]), limits[ids], near[ids], far[ids]) if ids else None


def _sample(scene: Scene, count: int) -> Gaussians:
    """Return about ``count`` of a scene's Gaussians, evenly among the rows, enlarged to cover as much as all do."""
    rows = np.arange(len(scene.gaussians))
    step = max(1, len(rows) // max(1, count))
    first = np.arange(0, len(rows) - step + 1, step)
    sample = scene.gaussians[rows[first + (step * (EVEN[0] * np.arange(len(first)) % 1)).astype(np.int64)]]
    return replace(sample, scales=sample.scales * np.float32(math.sqrt(step)))


def outside_cameras(
    means: np.ndarray, cameras: Cameras, count: int, low: Sequence[float], high: Sequence[float]
) -> Cameras:
    """Return ``count`` cameras, each stepped back from the points ``[n,3]`` that a camera sees and rotated about them.

    The centre of the rotation is the middle of the points. ``low`` and ``high`` are the least and the largest step
    back, rotation to the sides, and rotation up or down, in the units of ``LOW``.
    """
    depths = [middle_depth(means, cameras[[view]]) for view in range(min(count, len(cameras)))]
    views, viewmats = [number % len(cameras) for number in range(count)], []
    for number, view in enumerate(views):
        back, azimuth, elevation = low + (0.5 + number * EVEN) % 1 * np.subtract(high, low)
        viewmats.append(step_outside(cameras.viewmats[view], depths[view], back, azimuth, elevation))
    return replace(cameras, viewmats=np.stack(viewmats), Ks=cameras.Ks[views])


def mark_empty(opacities: np.ndarray) -> np.ndarray:
    """Mark the empty pixels of ``opacities [h,w]``, except for a rim around pixels that are not empty."""
    side = 2 * round(RIM * opacities.shape[1]) + 1
    empty = cv2.erode((opacities < EMPTY).astype(np.uint8), np.ones((side, side), np.uint8))
    return np.asarray(empty, bool)


def _tile(splats: Splats, views: Photos, view: int, near: float, tiles: np.ndarray | None = None) -> TiledView:
    return tile_view(splats, **views.camera(view), near=near, tiles=tiles)


def _tiles_of(weights: np.ndarray) -> np.ndarray:
    """Return a mask ``[lines,columns]`` of the tiles with weighted pixels; only these have to be drawn."""
    height, width = weights.shape
    padded = np.pad(weights > 0, ((0, -height % TILE), (0, -width % TILE)))
    return np.asarray(padded.reshape(-(-height // TILE), TILE, -1, TILE).any((1, 3)))


def veil_gradients(splats: Splats, outside: Outside, view: int) -> Gradients:
    """Return the gradients of what stands before the limits of a view, for each Gaussian with a part in it.

    The loss of a pixel is its opacity, less its blended depth over the limit; where the input is empty, it is the
    opacity. The loss of the view is the weighted mean over pixels. Where the input shows a surface, pixels with a loss
    of ``MARGIN`` or less do not count.
    """
    views, limits = outside.views, outside.limits[view]
    assert views.weights is not None
    tiled = _tile(splats, views, view, outside.near[view], _tiles_of(views.weights[view]))
    depths = depth_colors(tiled, outside.far[view])
    image, left = blend(tiled, depths, np.zeros(3, np.float32))
    inverse = np.where(limits > 0, 1 / np.maximum(limits, np.float32(1e-12)), np.float32(0))
    hidden = 1 - left - image[..., 0] * inverse
    weights = np.where((hidden > MARGIN) | np.isinf(limits), views.weights[view], 0) / np.float32(limits.size)
    wanted = np.zeros_like(image)
    wanted[..., 0] = -weights * inverse
    g = gradients_of(tiled, depths, image, left, wanted, -weights, with_viewmat=False)
    g.colors[:] = 0
    return g[np.flatnonzero(g.opacities > TOUCHED)]  # what stands behind should not gain opacity


def score_fog(splats: Splats, outside: Outside) -> float | None:
    """Measure the mean opacity, in [0, 1], where the input is empty in a sample of the views; None if it is nowhere."""
    fog, count = 0.0, 0
    for view in range(0, len(outside.views), -(-len(outside.views) // SCORED)):
        empty = np.isinf(outside.limits[view])
        _, left = blend_depths(_tile(splats, outside.views, view, outside.near[view], _tiles_of(empty)))
        fog += float((1 - left[empty]).sum(dtype=np.float64))
        count += int(empty.sum())
    return fog / count if count else None
