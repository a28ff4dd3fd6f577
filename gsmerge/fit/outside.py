"""Views from outside of the capture, in which a fit puts nothing where its input shows nothing or something behind.

Photos say nothing of what hangs in gaps between them or before other cameras, and a fit fills these gaps with large
Gaussians: fog and veils, to whoever steps back. So after a third of a run some steps look from behind and beside, above
and below, at opacities and depths alone.
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

# Least and largest step back, as a share of the depth of what a view sees, and turns about its middle to the sides, and
# up or down, degrees. Cameras that turn without a step back see what new views see, and would cost them their fill
LOW, HIGH = (0.4, -35.0, -25.0), (1.6, 35.0, 25.0)
# Steps of three numbers, modulo one, that fill a cube evenly however many there are (the R sequence of Roberts 2018)
EVEN = np.array([0.8191725134, 0.6710436067, 0.5497004779])
PLACES = 42  # views outside, at most, or as many as there are photos
SAMPLE = 2000  # Gaussians that say how far away the middle of a view lies
# Gaussians of the input for each photo, and of no more photos than there are places at most, that stand for all, made
# as much larger as they are fewer: a picture has as many pixels, however many photos there are
ROWS = 4000
NEAREST = 0.25  # of the depth of what a view sees: nearer to a camera nothing is looked at
# Quantile of depths in a view, and times that, from which on all count as one: a flyaway moves its pixel's mean depth
LAST, FARTHEST = 0.98, 4.0
EMPTY, SOLID = 0.15, 0.9  # opacities of the input: below it a pixel is empty, above it shows a surface
# Distance from what the input shows, as a share of the width, within which nothing is asked: what stands beside the
# outline fills what the foreground uncovers in new views
RIM = 0.04
# Share of the way to a surface that the mean depth of a pixel may lack before it counts as veiled
MARGIN = 0.15
# Gaussians of the start for each photo from which on fog weighs as much as errors of the photos: fewer and larger ones
# reach from the borders of photos into what is empty, and would leave both. LIGHT is the least weight; veils weigh more
MANY, LIGHT, VEIL = 1000, 0.15, 30
LEVEL = 3  # times a photo's pixel is one of the pictures: at 2 fog is as thin, at 4 a fifth thicker
LEAST_WIDTH = 64  # pixels of the pictures
LEAST = 0.005  # share of a picture that must be empty or solid for it to count
TOUCHED = 1e-9  # gradient of the opacity from which on a Gaussian takes part in a step
SCORED = 12  # views, at most, that the fog of a result is measured in


@dataclass(frozen=True, eq=False)
class Outside:
    """Views from outside, and how far each of their pixels sees."""

    views: Photos  # black; weights [v,h,w] of the pixels of which something is asked
    limits: np.ndarray  # [v,h,w] camera z before which nothing is to stand: infinite where nothing is to be at all
    near: np.ndarray  # [v] camera z from which on a view looks
    far: np.ndarray  # [v] camera z at which what is farther counts as being

    def contradict(self, points: np.ndarray, share: float) -> np.ndarray:
        """Return a mask ``[n]`` of points ``[n,3]`` that some view sees before a ``share`` of its limit."""
        cameras = Cameras(self.views.viewmats, self.views.Ks, self.views.width, self.views.height)
        pixels, z = project(points, cameras)
        inside = (z > self.near[:, None]) & is_inside(pixels, cameras)
        view, point = np.nonzero(inside)
        column, row = pixels[inside].astype(np.int64).T
        wrong = z[inside] < share * self.limits[view, row, column]
        return np.bincount(point[wrong], minlength=len(points)) > 0


def look_outside(scene: Scene, start: Gaussians, photos: Photos, options: FitOptions) -> Outside | None:
    """Place views outside the capture for a fit from a ``start``, and see how far into the scene they look.

    Cameras step back from those of ``photos``. Pictures are a third as large, at least ``LEAST_WIDTH`` wide. None if no
    step looks there, or the scene says nothing in any of them; of a scene without Gaussians, as views of blocks are
    joined, the start says it.
    """
    looks = math.ceil(options.steps * (1 - options.tuning.outside_from) / options.tuning.outside_every)
    if looks == 0:
        return None
    rows = _sample(scene, ROWS * min(len(photos), PLACES)) if len(scene.gaussians) else start
    if len(rows) == 0 or len(photos) == 0:
        return None
    cameras = Cameras(photos.viewmats, photos.Ks, photos.width, photos.height)
    points = rows.means[:: max(1, len(rows) // SAMPLE)]
    placed = outside_cameras(points, cameras, min(looks, max(PLACES, len(photos))), LOW, HIGH)
    depths = [depths_inside(points, cameras[[view]]) for view in range(min(len(placed), len(cameras)))]
    near, far = np.resize([np.quantile(some, (0.5, LAST)) for some in depths], (len(placed), 2)).T
    near, far = NEAREST * near, FARTHEST * far
    views, drawn = blank_photos(placed, min(LEVEL, photos.width / LEAST_WIDTH)), make_splats(rows)

    def look(view: int) -> np.ndarray:
        depths, left = blend_depths(_tile(drawn, views, view, near[view]), far[view])
        opacities = 1 - left
        return np.where(mark_empty(opacities), np.inf, np.where(opacities > SOLID, depths, 0)).astype(np.float32)

    limits = np.stack(list(in_turn(look, range(len(views)))))
    weight = np.float32(np.clip(len(start) / (MANY * len(photos)), LIGHT, 1.0))
    weights = weight * np.where(np.isinf(limits), 1, np.where(limits > 0, VEIL, 0)).astype(np.float32)
    kept = np.flatnonzero((limits > 0).mean((1, 2)) > LEAST).tolist()
    return Outside(replace(views[kept], weights=weights[kept]), limits[kept], near[kept], far[kept]) if kept else None


def _sample(scene: Scene, count: int) -> Gaussians:
    """Return about ``count`` of a scene's Gaussians, evenly among the rows, so large that they cover what all do."""
    rows = np.arange(len(scene.gaussians))
    step = max(1, len(rows) // max(1, count))
    first = np.arange(0, len(rows) - step + 1, step)
    some = scene.gaussians[rows[first + (step * (EVEN[0] * np.arange(len(first)) % 1)).astype(np.int64)]]
    return replace(some, scales=some.scales * np.float32(math.sqrt(step)))


def outside_cameras(
    means: np.ndarray, cameras: Cameras, count: int, low: Sequence[float], high: Sequence[float]
) -> Cameras:
    """Step back from the points ``[n,3]`` that each camera sees, and turn about their middle: ``count`` cameras.

    ``low``, ``high``: least and largest step back, and turns to the sides, and up or down; as of ``LOW``.
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
    """Return a mask ``[lines,columns]`` of the tiles with weighted pixels, since other tiles need not be drawn."""
    height, width = weights.shape
    padded = np.pad(weights > 0, ((0, -height % TILE), (0, -width % TILE)))
    return np.asarray(padded.reshape(-(-height // TILE), TILE, -1, TILE).any((1, 3)))


def veil_gradients(splats: Splats, outside: Outside, view: int) -> Gradients:
    """Return the gradients of each Gaussian that stands before the limits of a view, of what it hides there.

    That is the weighted mean of the opacity less the share of the limit at which what is blended stands: the opacity
    itself where nothing is to be. Where no more than ``MARGIN`` of a limit is lacking, nothing is asked.
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
    return g[np.flatnonzero(g.opacities > TOUCHED)]  # what stands behind is not to gain opacity


def score_fog(splats: Splats, outside: Outside) -> float | None:
    """Measure the mean opacity, in [0, 1], where nothing is to be, over a sample of the views; None: nowhere."""
    fog, count = 0.0, 0
    for view in range(0, len(outside.views), -(-len(outside.views) // SCORED)):
        empty = np.isinf(outside.limits[view])
        _, left = blend_depths(_tile(splats, outside.views, view, outside.near[view], _tiles_of(empty)))
        fog += float((1 - left[empty]).sum(dtype=np.float64))
        count += int(empty.sum())
    return fog / count if count else None
