"""Place views outside of the capture, from which a fit removes fog and veils.

Photos do not show the space between their fields of view, nor the space close to other cameras. A fit fills spaces that
no photo shows with large Gaussians. A viewer who steps back sees these large Gaussians as fog where the input is empty,
and as veils in front of the input's surfaces. To remove fog and veils, some steps of a fit draw the Gaussians from
cameras behind, beside, above and below the photos. The opacities and depths in these views are compared with renders of
the input.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.method.geometry.transforms import depths_inside, is_inside, middle_depth, project, quantiles, step_outside
from gsmerge.method.kernels.raster.project import TILE
from gsmerge.method.raster import Splats, make_splats, tile_view
from gsmerge.method.raster.composite import blend, blend_depths, depth_colors
from gsmerge.method.raster.gradient import Gradients, gradients_of
from gsmerge.method.raster.photos import Photos, blank_photos
from gsmerge.runtime.threads import in_turn
from gsmerge.settings.fit import FitOptions
from gsmerge.types import Cameras, Gaussians, Scene

# Least and largest step back as a share of a view's median depth, rotation to the sides about the middle of the view in
# degrees, and rotation up or down in degrees. Without a step back, cameras would see what new views between the photos
# see, in which a fit has to fill gaps
STEP_BACK_LOW = (0.4, -35.0, -25.0)
STEP_BACK_HIGH = (1.6, 35.0, 25.0)
# The multiples of EVEN, modulo one, fill a cube evenly, whatever the number of multiples (the R sequence of Roberts
# 2018)
EVEN = np.array([0.8191725134, 0.6710436067, 0.5497004779])
PLACES = 42  # largest number of views from outside, if there are not more photos; then one for each photo
DEPTH_GAUSSIANS = 2000  # the depths of views are measured on at least this many Gaussians, or on all if there are fewer
# The views from outside are drawn from a sample of the input. The sample has GAUSSIANS_PER_PHOTO Gaussians for each
# photo, but counts at most PLACES photos, because more photos do not make the pictures larger
GAUSSIANS_PER_PHOTO = 4000
OUTSIDE_NEAR_PLANE = 0.25  # depth of the near plane, as a share of the median depth of a view
# Depths are clipped to at most FAR_FACTOR times their quantile FAR_QUANTILE, because a single Gaussian far behind the
# scene would change the mean depth of its pixels
FAR_QUANTILE = 0.98
FAR_FACTOR = 4.0
# A pixel of the input is empty below EMPTY_OPACITY, and shows a surface above SOLID_OPACITY
EMPTY_OPACITY = 0.15
SOLID_OPACITY = 0.9
# Width of the rim around the outlines of the input, as a share of the picture's width. Empty pixels in the rim do not
# count, because Gaussians beside an outline fill the background that becomes visible in new views
RIM_SHARE = 0.04
# A pixel is veiled if its loss (see veil_gradients) is above VEILED_LOSS. An opaque pixel is veiled if its mean depth
# is less than the limit of its depth by more than the share VEILED_LOSS of this limit
VEILED_LOSS = 0.15
# The weight of fog in the loss is 1 if the start has at least MANY_PER_PHOTO Gaussians for each photo. If a start has
# fewer Gaussians, each one is larger and reaches from the borders of photos into empty space. With a fog weight of 1,
# the large Gaussians would vanish, although photos show them. So fewer Gaussians mean a smaller weight of fog, but at
# least LEAST_FOG_WEIGHT. VEIL_WEIGHT is the weight of veils relative to fog
MANY_PER_PHOTO = 1000
LEAST_FOG_WEIGHT = 0.15
VEIL_WEIGHT = 30
OUTSIDE_LEVEL = 3  # width of a pixel of the pictures, in pixels of a photo: 2 leaves as much fog, 4 a fifth more
LEAST_WIDTH = 64  # least width of the pictures, pixels
SCORED = 12  # the fog of a result is measured in at most about this many views


@dataclass(frozen=True, eq=False)
class Outside:
    """Views from outside, and the depth of the surface that the input shows in each of their pixels."""

    views: Photos  # Cameras with black pictures; the weights [v,h,w] are 0 for pixels that do not count
    # [v,h,w] least camera z that Gaussians may have in each pixel: infinite where the input is empty, 0 where Gaussians
    # may be anywhere
    limits: np.ndarray
    near: np.ndarray  # [v] camera z of the near plane
    far: np.ndarray  # [v] camera z to which larger depths are clipped

    def contradict(self, points: np.ndarray, share: float) -> np.ndarray:
        """Return a mask ``[n]`` of the ``points [n,3]`` that some view sees nearer than ``share`` times its limit."""
        cameras = Cameras(self.views.viewmats, self.views.Ks, self.views.width, self.views.height)
        pixels, z = project(points, cameras)
        inside = (z > self.near[:, None]) & is_inside(pixels, cameras)
        view_ids, point_ids = np.nonzero(inside)
        columns, rows = pixels[inside].astype(np.int64).T
        too_near = z[inside] < share * self.limits[view_ids, rows, columns]
        return np.bincount(point_ids[too_near], minlength=len(points)) > 0


def place_outside_views(scene: Scene, start: Gaussians, photos: Photos, options: FitOptions) -> Outside | None:
    """Place views outside of the capture for a fit, and draw the scene in them to find the limits of depths.

    Each camera is a camera of ``photos``, stepped back and rotated. Pictures are a third as wide as the photos, but at
    least ``LEAST_WIDTH`` pixels. If the scene has no Gaussians, as when blocks are joined, the ``start`` of the fit is
    drawn instead. Returns None if the fit has no steps for views from outside, or if every view has too few pixels that
    count.
    """
    num_steps = math.ceil(options.steps * (1 - options.tuning.outside_from) / options.tuning.outside_every)
    if num_steps == 0:  # steps on views from outside
        return None
    sample = sample_gaussians(scene, GAUSSIANS_PER_PHOTO * min(len(photos), PLACES)) if len(scene.gaussians) else start
    if len(sample) == 0 or len(photos) == 0:
        return None
    cameras = Cameras(photos.viewmats, photos.Ks, photos.width, photos.height, photos.antialiased)
    points = sample.means[:: max(1, len(sample) // DEPTH_GAUSSIANS)]
    placed = outside_cameras(points, cameras, min(num_steps, max(PLACES, len(photos))), STEP_BACK_LOW, STEP_BACK_HIGH)
    # the depths of a view are the depths of points in the camera from which it steps back, each of `cameras` in turn
    depths = [depths_inside(points, cameras[[view]]) for view in range(min(len(placed), len(cameras)))]
    ranges = [quantiles(view_depths, (0.5, FAR_QUANTILE)) for view_depths in depths]
    median, farthest = np.resize(ranges, (len(placed), 2)).T
    near = OUTSIDE_NEAR_PLANE * median
    far = FAR_FACTOR * farthest
    views, splats = blank_photos(placed, min(OUTSIDE_LEVEL, photos.width / LEAST_WIDTH)), make_splats(sample)

    def find_limits(view: int) -> np.ndarray:
        """Return the depth of the surface in each pixel, inf for empty pixels, and 0 for partly transparent pixels."""
        depths, transmittance = blend_depths(tile_view(splats, **views.camera(view), near=near[view]), far[view])
        opacities = 1 - transmittance
        limits = np.where(opacities > SOLID_OPACITY, depths, 0)
        return np.where(mark_empty(opacities), np.inf, limits).astype(np.float32)

    limits = np.stack(list(in_turn(find_limits, range(len(views)))))
    fog_weight = np.float32(np.clip(len(start) / (MANY_PER_PHOTO * len(photos)), LEAST_FOG_WEIGHT, 1.0))
    weights = fog_weight * np.where(np.isinf(limits), 1, np.where(limits > 0, VEIL_WEIGHT, 0)).astype(np.float32)
    min_share = 0.005  # a picture counts if more than min_share of its pixels are empty or solid
    ids = np.flatnonzero((limits > 0).mean((1, 2)) > min_share).tolist()
    return Outside(replace(views[ids], weights=weights[ids]), limits[ids], near[ids], far[ids]) if ids else None


def sample_gaussians(scene: Scene, count: int) -> Gaussians:
    """Return about ``count`` Gaussians of a scene, spread evenly over its rows and enlarged to cover the same area."""
    num_rows = len(scene.gaussians)
    step = max(1, num_rows // max(1, count))
    starts = np.arange(0, num_rows - step + 1, step)  # one Gaussian is taken from each run of `step` rows
    places = EVEN[0] * np.arange(len(starts)) % 1  # its place in the run, in [0, 1)
    sample = scene.gaussians[starts + (step * places).astype(np.int64)]
    return replace(sample, scales=sample.scales * np.float32(math.sqrt(step)))


def outside_cameras(
    means: np.ndarray, cameras: Cameras, count: int, low: Sequence[float], high: Sequence[float]
) -> Cameras:
    """Return ``count`` cameras: each of ``cameras`` in turn, stepped back and rotated about the middle of what it sees.

    The middle is at the middle depth of the points ``means [n,3]``. ``low`` and ``high`` bound the step back and the
    rotations, like ``STEP_BACK_LOW`` and ``STEP_BACK_HIGH``.
    """
    depths = [middle_depth(means, cameras[[view]]) for view in range(min(count, len(cameras)))]
    views = [number % len(cameras) for number in range(count)]
    viewmats = []
    for number, view in enumerate(views):
        back, azimuth, elevation = low + (0.5 + number * EVEN) % 1 * np.subtract(high, low)
        viewmats.append(step_outside(cameras.viewmats[view], depths[view], back, azimuth, elevation))
    return replace(cameras, viewmats=np.stack(viewmats), Ks=cameras.Ks[views])


def mark_empty(opacities: np.ndarray) -> np.ndarray:
    """Return a mask ``[h,w]`` of pixels with ``opacities [h,w]`` below EMPTY_OPACITY, less a rim at their borders."""
    side = 2 * round(RIM_SHARE * opacities.shape[1]) + 1
    empty = cv2.erode((opacities < EMPTY_OPACITY).astype(np.uint8), np.ones((side, side), np.uint8))
    return np.asarray(empty, bool)


def _tiles_of(weights: np.ndarray) -> np.ndarray:
    """Return a mask ``[lines,columns]`` of the tiles that are drawn, because some of their pixels have a weight."""
    height, width = weights.shape
    padded = np.pad(weights > 0, ((0, -height % TILE), (0, -width % TILE)))
    return np.asarray(padded.reshape(-(-height // TILE), TILE, -1, TILE).any((1, 3)))


def veil_gradients(splats: Splats, outside: Outside, view: int) -> Gradients:
    """Return the gradients of a loss that measures fog and veils in a view, for the Gaussians that increase it.

    The loss of a pixel is its opacity minus the quotient of its blended depth and its limit. Where the input is empty,
    the loss is the opacity. Where the input shows a surface, pixels with a loss of ``VEILED_LOSS`` or less do not
    count. The loss of the view is the weighted mean over its pixels.
    """
    views = outside.views
    limits = outside.limits[view]
    assert views.weights is not None
    tiles = _tiles_of(views.weights[view])
    tiled = tile_view(splats, **views.camera(view), near=outside.near[view], tiles=tiles)
    depths = depth_colors(tiled, outside.far[view])
    image, transmittance = blend(tiled, depths, np.zeros(3, np.float32))  # the depth is in the first channel
    inverse_limits = np.where(limits > 0, 1 / np.maximum(limits, np.float32(1e-12)), np.float32(0))
    losses = 1 - transmittance - image[..., 0] * inverse_limits
    weights = np.where((losses > VEILED_LOSS) | np.isinf(limits), views.weights[view], 0) / np.float32(limits.size)
    image_gradient = np.zeros_like(image)
    image_gradient[..., 0] = -weights * inverse_limits
    g = gradients_of(
        tiled, depths, image=image, transmittance=transmittance, grad_image=image_gradient, grad_left=-weights,
        with_viewmat=False,
    )  # fmt: skip
    g.colors[:] = 0  # the colours drawn were depths, so the gradients mean nothing for colours
    min_gradient = 1e-9  # Gaussians with a smaller gradient are behind the limit, and should not gain opacity
    return g[np.flatnonzero(g.opacities > min_gradient)]


def score_fog(splats: Splats, outside: Outside) -> float | None:
    """Return the mean opacity, in [0, 1], of all pixels in which the input is empty, or None without empty pixels.

    At most about ``SCORED`` evenly spaced views from outside are drawn.
    """
    fog = 0.0
    count = 0
    for view in range(0, len(outside.views), -(-len(outside.views) // SCORED)):
        empty = np.isinf(outside.limits[view])
        tiled = tile_view(splats, **outside.views.camera(view), near=outside.near[view], tiles=_tiles_of(empty))
        _, transmittance = blend_depths(tiled)
        fog += float((1 - transmittance[empty]).sum(dtype=np.float64))
        count += int(empty.sum())
    return fog / count if count else None
