"""Views from outside of the capture, in which a fit keeps empty what its start shows as empty.

Photos say nothing of what hangs in gaps between them, and a fit fills these gaps with large Gaussians: fog, to whoever
steps back. So after a third of a run some steps look from behind and beside, above and below, at opacities alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from gsmerge.geometry import middle_depth, step_outside
from gsmerge.kernels.raster.project import TILE
from gsmerge.raster import Splats, tile_view
from gsmerge.raster.composite import blend
from gsmerge.raster.gradient import Gradients, gradients_of
from gsmerge.raster.photos import Photos, blank_photos
from gsmerge.raster.tiled_view import TiledView
from gsmerge.runtime.threads import in_turn
from gsmerge.settings.fit import FitOptions
from gsmerge.types import Cameras

# Least and largest step back, as a share of the depth of what a view sees, and turns about its middle to the sides, and
# up or down, degrees. Cameras that turn without a step back see what new views see, and would cost them their fill
LOW, HIGH = (0.4, -35.0, -25.0), (1.6, 35.0, 25.0)
# Steps of three numbers, modulo one, that fill a cube evenly however many there are (the R sequence of Roberts 2018)
EVEN = np.array([0.8191725134, 0.6710436067, 0.5497004779])
PLACES = 24  # views outside, at most, or as many as there are photos
SAMPLE = 2000  # Gaussians that say how far away the middle of a view lies
EMPTY = 0.05  # opacity of the start below which a pixel is empty
# Distance from what the start shows, as a share of the width, within which nothing is asked: what stands beside the
# outline fills what the foreground uncovers in new views
RIM = 0.08
# Gaussians of the start for each photo from which on fog weighs as much as errors of the photos: fewer and larger ones
# reach from the borders of photos into what is empty, and would leave both. LIGHT is the least weight
MANY, LIGHT = 1000, 0.15
LEAST_WIDTH = 64  # pixels of the pictures
LEAST = 0.005  # share of a picture that must be empty for it to count
TOUCHED = 1e-9  # gradient of the opacity from which on a Gaussian takes part in a step
SCORED = 12  # views, at most, that the fog of a result is measured in


def outside_views(start: Splats, photos: Photos, options: FitOptions) -> Photos | None:
    """Place views outside the capture for a fit; only pixels where the start shows nothing have weights above 0.

    Cameras step back from those of ``photos``. Pictures are black and half as large, at least ``LEAST_WIDTH`` wide.
    None if the start fills all of them.
    """
    if len(start) == 0 or len(photos) == 0:
        return None
    cameras = Cameras(photos.viewmats, photos.Ks, photos.width, photos.height)
    looks = math.ceil(options.steps * (1 - options.tuning.outside_from) / options.tuning.outside_every)
    points = start.means[:: max(1, len(start) // SAMPLE)] + start.origin
    placed = outside_cameras(points, cameras, min(looks, max(PLACES, len(photos))), LOW, HIGH)
    views = blank_photos(placed, min(2, photos.width / LEAST_WIDTH))

    def mark(view: int) -> np.ndarray:
        return mark_empty(1 - _blend_black(start, views, view)[1])

    marks = list(in_turn(mark, range(len(views))))
    kept = [view for view, empty in enumerate(marks) if empty.mean() > LEAST]
    weight = np.float32(np.clip(len(start) / (MANY * len(photos)), LIGHT, 1.0))
    return replace(views[kept], weights=weight * np.stack([marks[view] for view in kept])) if kept else None


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


def _blend_black(
    splats: Splats, views: Photos, view: int, tiles: np.ndarray | None = None
) -> tuple[TiledView, np.ndarray]:
    """Tile a view and blend black Gaussians in it; return the view and the transmittance ``[h,w]``."""
    tiled = tile_view(splats, **views.camera(view), tiles=tiles)
    return tiled, blend(tiled, np.zeros((len(tiled.ids), 3), np.float32), np.zeros(3, np.float32))[1]


def _tiles_of(weights: np.ndarray) -> np.ndarray:
    """Return a mask ``[lines,columns]`` of the tiles with weighted pixels, since other tiles need not be drawn."""
    height, width = weights.shape
    padded = np.pad(weights > 0, ((0, -height % TILE), (0, -width % TILE)))
    return np.asarray(padded.reshape(-(-height // TILE), TILE, -1, TILE).any((1, 3)))


def fog_gradients(splats: Splats, views: Photos, view: int) -> Gradients:
    """Return the gradients of each Gaussian for the fog of a view, which is the weighted mean of its opacity."""
    assert views.weights is not None
    weights = views.weights[view]
    tiled, transmittance = _blend_black(splats, views, view, _tiles_of(weights))
    black, colors = np.zeros((*weights.shape, 3), np.float32), np.zeros((len(tiled.ids), 3), np.float32)
    wanted = weights / np.float32(-weights.size)  # of the transmittance, which is 1 - opacity
    g = gradients_of(tiled, colors, black, transmittance, black, wanted, with_viewmat=False)
    return g[np.flatnonzero(np.abs(g.opacities) > TOUCHED)]


def score_fog(splats: Splats, views: Photos) -> float:
    """Measure the weighted mean opacity, in [0, 1], of the Gaussians over a sample of the views from outside."""
    assert views.weights is not None
    fog, count = 0.0, 0.0
    for view in range(0, len(views), -(-len(views) // SCORED)):
        weights = views.weights[view]
        _, transmittance = _blend_black(splats, views, view, _tiles_of(weights))
        fog += float((weights * (1 - transmittance)).sum(dtype=np.float64))
        count += float(weights.sum(dtype=np.float64))
    return fog / count
