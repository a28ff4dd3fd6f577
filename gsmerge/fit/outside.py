"""Views from outside of the capture, from which a fit removes fog and veils.

Photos do not show the space between them or in front of other cameras, and a fit fills it with large Gaussians. A
viewer who steps back sees them as fog where the input is empty, and as veils in front of its surfaces. So some steps of
a fit draw views from behind, beside, above and below, and compare their opacities and depths with the input's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from gsmerge.geometry.transforms import depths_inside, is_inside, middle_depth, project, quantiles, step_outside
from gsmerge.kernels.raster.project import TILE
from gsmerge.raster import Splats, make_splats, tile_view
from gsmerge.raster.composite import blend, blend_depths, depth_colors
from gsmerge.raster.gradient import Gradients, gradients_of
from gsmerge.raster.photos import Photos, blank_photos
from gsmerge.raster.tiled_view import TiledView
from gsmerge.runtime.threads import in_turn
from gsmerge.settings.fit import FitOptions
from gsmerge.types import Cameras, Gaussians, Scene

# Bounds of three numbers: the step back, as a share of the median depth of a view; the rotation to the sides about the
# middle of the view, degrees; and the rotation up or down, degrees. Without a step back the cameras would see the same
# as new views, in which a fit has to fill gaps
STEP_BACK_LOW, STEP_BACK_HIGH = (0.4, -35.0, -25.0), (1.6, 35.0, 25.0)
# Multiples of this vector, modulo one, fill a cube evenly, whatever their number (the R sequence of Roberts 2018)
EVEN = np.array([0.8191725134, 0.6710436067, 0.5497004779])
PLACES = 42  # most views from outside, or the number of photos if that is more
DEPTH_GAUSSIANS = 2000  # the depths of views are measured by at least this many Gaussians, if there are as many
# Gaussians for each photo, of at most PLACES photos, that represent the whole input. The fewer they are, the larger
# they are made, because a picture has the same number of pixels, however many photos there are
GAUSSIANS_PER_PHOTO = 4000
OUTSIDE_NEAR_PLANE = 0.25  # near plane, as a share of the median depth of a view
# Larger depths are clipped to FAR_FACTOR times the quantile FAR_QUANTILE of the depths, because a flyaway moves the
# mean depth of its pixels
FAR_QUANTILE, FAR_FACTOR = 0.98, 4.0
# Opacities of the input below which a pixel is empty, and above which it shows a surface
EMPTY_OPACITY, SOLID_OPACITY = 0.15, 0.9
# Empty pixels do not count within this distance of the input's outlines, as a share of the width, because Gaussians
# beside an outline fill the background that the foreground uncovers in new views
RIM_SHARE = 0.04
# A pixel is veiled if its loss (see veil_gradients) is larger: the mean depth is less by such a share
VEILED_LOSS = 0.15
# With at least MANY_PER_PHOTO Gaussians of the start for each photo, fog weighs as much as errors of the photos. If
# there are fewer, they are larger and reach from the borders of photos into empty space. With the full weight they
# would vanish from both, so fog weighs less, but at least LEAST_FOG_WEIGHT. VEIL_WEIGHT is the weight of veils relative
# to fog
MANY_PER_PHOTO, LEAST_FOG_WEIGHT, VEIL_WEIGHT = 1000, 0.15, 30
OUTSIDE_LEVEL = 3  # size of a picture's pixels in pixels of the photo; at 2 fog is as thin, at 4 it is a fifth thicker
LEAST_WIDTH = 64  # least width of the pictures, pixels
SCORED = 12  # most views in which the fog of a result is measured


@dataclass(frozen=True, eq=False)
class Outside:
    """Views from outside, and the depth of the input's surface in each pixel."""

    views: Photos  # Black pictures; weights [v,h,w] are 0 for pixels that do not count
    # [v,h,w] least camera z of Gaussians in each pixel: infinite where the input is empty, 0 where there is no limit
    limits: np.ndarray
    near: np.ndarray  # [v] camera z of the near plane
    far: np.ndarray  # [v] camera z to which larger depths are clipped

    def contradict(self, points: np.ndarray, share: float) -> np.ndarray:
        """Return a mask ``[n]`` of the points ``[n,3]`` that some view sees nearer than a ``share`` of the limit."""
        cameras = Cameras(self.views.viewmats, self.views.Ks, self.views.width, self.views.height)
        pixels, z = project(points, cameras)
        inside = (z > self.near[:, None]) & is_inside(pixels, cameras)
        view, point = np.nonzero(inside)
        column, row = pixels[inside].astype(np.int64).T
        wrong = z[inside] < share * self.limits[view, row, column]
        return np.bincount(point[wrong], minlength=len(points)) > 0


def place_outside_views(scene: Scene, start: Gaussians, photos: Photos, options: FitOptions) -> Outside | None:
    """Place views outside of the capture for a fit from a ``start``, and draw the scene in them to find their limits.

    The cameras are those of ``photos``, stepped back. Pictures are a third as large, at least ``LEAST_WIDTH`` wide. If
    the scene has no Gaussians, as when blocks are joined, the start is drawn instead. Returns None if no step draws a
    view from outside, or if too few pixels of each view would count.
    """
    num_steps = math.ceil(options.steps * (1 - options.tuning.outside_from) / options.tuning.outside_every)
    if num_steps == 0:
        return None
    sample = sample_gaussians(scene, GAUSSIANS_PER_PHOTO * min(len(photos), PLACES)) if len(scene.gaussians) else start
    if len(sample) == 0 or len(photos) == 0:
        return None
    cameras = Cameras(photos.viewmats, photos.Ks, photos.width, photos.height)
    points = sample.means[:: max(1, len(sample) // DEPTH_GAUSSIANS)]
    placed = outside_cameras(points, cameras, min(num_steps, max(PLACES, len(photos))), STEP_BACK_LOW, STEP_BACK_HIGH)
    near, far = _depth_range(points, cameras, len(placed))
    views = blank_photos(placed, min(OUTSIDE_LEVEL, photos.width / LEAST_WIDTH))
    limits = _find_limits(make_splats(sample), views, near, far)
    fog_weight = np.float32(np.clip(len(start) / (MANY_PER_PHOTO * len(photos)), LEAST_FOG_WEIGHT, 1.0))
    weights = fog_weight * np.where(np.isinf(limits), 1, np.where(limits > 0, VEIL_WEIGHT, 0)).astype(np.float32)
    min_share = 0.005  # a picture counts if more than this share of it is empty or solid
    ids = np.flatnonzero((limits > 0).mean((1, 2)) > min_share).tolist()
    return Outside(replace(views[ids], weights=weights[ids]), limits[ids], near[ids], far[ids]) if ids else None


def _depth_range(points: np.ndarray, cameras: Cameras, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the near plane and the largest depth of ``count`` views from outside, each ``[count]``.

    They follow from the depths of ``points [n,3]`` in the ``cameras`` from which the views step back, in turn.
    """
    depths = [depths_inside(points, cameras[[view]]) for view in range(min(count, len(cameras)))]
    median, last = np.resize([quantiles(view_depths, (0.5, FAR_QUANTILE)) for view_depths in depths], (count, 2)).T
    return OUTSIDE_NEAR_PLANE * median, FAR_FACTOR * last


def _find_limits(splats: Splats, views: Photos, near: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Draw the input in v views from outside; return the limits ``[v,h,w]`` of :class:`Outside`."""

    def view_limits(view: int) -> np.ndarray:
        """Return the depth of what the input shows in each pixel; 0: it is half transparent, inf: empty."""
        depths, transmittance = blend_depths(_tile(splats, views, view, near[view]), far[view])
        opacities = 1 - transmittance
        limits = np.where(opacities > SOLID_OPACITY, depths, 0)
        return np.where(mark_empty(opacities), np.inf, limits).astype(np.float32)

    return np.stack(list(in_turn(view_limits, range(len(views)))))


def sample_gaussians(scene: Scene, count: int) -> Gaussians:
    """Return about ``count`` of a scene's Gaussians, evenly among the rows, enlarged to cover the same area."""
    num_rows = len(scene.gaussians)
    step = max(1, num_rows // max(1, count))
    starts = np.arange(0, num_rows - step + 1, step)  # one Gaussian is taken from each run of `step` rows
    sample = scene.gaussians[starts + (step * (EVEN[0] * np.arange(len(starts)) % 1)).astype(np.int64)]
    return replace(sample, scales=sample.scales * np.float32(math.sqrt(step)))


def outside_cameras(
    means: np.ndarray, cameras: Cameras, count: int, low: Sequence[float], high: Sequence[float]
) -> Cameras:
    """Return ``count`` cameras: the given ``cameras`` in turn, each stepped back and rotated about the middle it sees.

    The middle is at the middle depth of the points ``means [n,3]``. ``low`` and ``high`` are the least and the largest
    step back, rotation to the sides, and rotation up or down, in the units of ``STEP_BACK_LOW``.
    """
    depths = [middle_depth(means, cameras[[view]]) for view in range(min(count, len(cameras)))]
    views, viewmats = [number % len(cameras) for number in range(count)], []
    for number, view in enumerate(views):
        back, azimuth, elevation = low + (0.5 + number * EVEN) % 1 * np.subtract(high, low)
        viewmats.append(step_outside(cameras.viewmats[view], depths[view], back, azimuth, elevation))
    return replace(cameras, viewmats=np.stack(viewmats), Ks=cameras.Ks[views])


def mark_empty(opacities: np.ndarray) -> np.ndarray:
    """Mark the empty pixels of ``opacities [h,w]``, except for a rim around pixels that are not empty."""
    side = 2 * round(RIM_SHARE * opacities.shape[1]) + 1
    empty = cv2.erode((opacities < EMPTY_OPACITY).astype(np.uint8), np.ones((side, side), np.uint8))
    return np.asarray(empty, bool)


def _tile(splats: Splats, views: Photos, view: int, near: float, tiles: np.ndarray | None = None) -> TiledView:
    return tile_view(splats, **views.camera(view), near=near, tiles=tiles)


def _tiles_of(weights: np.ndarray) -> np.ndarray:
    """Return a mask ``[lines,columns]`` of the tiles with weighted pixels; only these have to be drawn."""
    height, width = weights.shape
    padded = np.pad(weights > 0, ((0, -height % TILE), (0, -width % TILE)))
    return np.asarray(padded.reshape(-(-height // TILE), TILE, -1, TILE).any((1, 3)))


def veil_gradients(splats: Splats, outside: Outside, view: int) -> Gradients:
    """Return the gradients of the fog and the veils in a view, for each Gaussian with an effect on them.

    The loss of a pixel is its opacity minus the quotient of its blended depth and the limit. Where the input is empty,
    the loss is the opacity. The loss of the view is the weighted mean over pixels. Where the input shows a surface,
    pixels with a loss of ``VEILED_LOSS`` or less do not count.
    """
    views, limits = outside.views, outside.limits[view]
    assert views.weights is not None
    tiled = _tile(splats, views, view, outside.near[view], _tiles_of(views.weights[view]))
    depths = depth_colors(tiled, outside.far[view])
    image, transmittance = blend(tiled, depths, np.zeros(3, np.float32))  # the depth is in the first channel
    inverse_limits = np.where(limits > 0, 1 / np.maximum(limits, np.float32(1e-12)), np.float32(0))
    losses = 1 - transmittance - image[..., 0] * inverse_limits
    weights = np.where((losses > VEILED_LOSS) | np.isinf(limits), views.weights[view], 0) / np.float32(limits.size)
    image_gradient = np.zeros_like(image)
    image_gradient[..., 0] = -weights * inverse_limits
    g = gradients_of(tiled, depths, image, transmittance, image_gradient, -weights, with_viewmat=False)
    g.colors[:] = 0
    min_gradient = 1e-9  # a Gaussian takes part in a step if the gradient of its opacity is larger
    return g[np.flatnonzero(g.opacities > min_gradient)]  # Gaussians behind the limit should not gain opacity


def score_fog(splats: Splats, outside: Outside) -> float | None:
    """Measure the mean opacity, in [0, 1], of pixels at which the input is empty; None if there are none.

    At most about ``SCORED`` evenly spaced views are drawn.
    """
    fog, count = 0.0, 0
    for view in range(0, len(outside.views), -(-len(outside.views) // SCORED)):
        empty = np.isinf(outside.limits[view])
        _, transmittance = blend_depths(_tile(splats, outside.views, view, outside.near[view], _tiles_of(empty)))
        fog += float((1 - transmittance[empty]).sum(dtype=np.float64))
        count += int(empty.sum())
    return fog / count if count else None
