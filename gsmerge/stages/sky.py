"""Detection of sky Gaussians by the photos, without a network or a download.

In each photo sky is a smooth region that comes down from the upper border, nowhere warmer than
grey, and that pales towards the horizon, as air does; without that, as under clouds, it has to be
several times as far away as the rest. Ceilings and white walls have the first three in common with
it, seldom the others, and never in several views.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce

import cv2
import numpy as np

from gsmerge.geometry import correlation, is_inside, project
from gsmerge.kernels.pictures import blur, sobel
from gsmerge.raster import make_splats, tile_view
from gsmerge.raster.photos import NEAR_PLANE
from gsmerge.raster.weights import apply_transposed, view_weights
from gsmerge.types import Cameras, Gaussians

SIDE = 480.0  # pixels of the longer side that gradients are measured for
SMOOTH = 0.02  # largest gradient of a colour per pixel
DARK, WHITE, GREY = 0.35, 0.75, 0.12  # sky is blue and no darker, or brighter than the second with so little chroma
WARM = 0.03  # most that red exceeds blue, in nine tenths of the region
LEAST_AREA, LEAST_TOP = 0.02, 0.4  # of the picture, and of its upper border
PALER, PALER_RANGE = -0.12, 0.08  # correlation of saturation with the row, at most; and spread of saturation, at least
FAR = 3.0  # times the depth of the rest
LEAST_VIEWS, LEAST_SHARE = 2, 0.2  # views that show sky, and their share of all: fewer may be mistaken
AGREEMENT = 0.7  # least share of a Gaussian's blending weights that lies in the sky
LAYERS, LAST_LAYER = 6, 0.02  # most rounds; share of all sky so far that a round which is the last adds
MAX_SAMPLE_GAUSSIANS = 200_000  # Gaussians that depths are taken from


def sky(gaussians: Gaussians, cameras: Cameras, photos: np.ndarray) -> np.ndarray:
    """Return a mask ``[n]`` of canonical Gaussians that contribute mostly to the sky of the photos."""
    regions, mask = sky_regions(gaussians.means, cameras, photos), np.zeros(len(gaussians), bool)
    if not regions:
        return mask
    for _ in range(LAYERS):  # what the sky in front has hidden comes next
        rows = np.flatnonzero(~mask)
        above = _mostly_inside(gaussians[rows], cameras, regions)
        mask[rows[above]] = True
        if above.sum() < LAST_LAYER * mask.sum():
            break
    return mask


def sky_regions(means: np.ndarray, cameras: Cameras, photos: np.ndarray) -> dict[int, np.ndarray]:
    """Return a mask ``[h,w]`` of the sky for each view that shows sky, by view; empty if too few views do."""
    regions = {view: region for view, photo in enumerate(photos) if (region := sky_region(photo)).any()}
    shown = {
        view: region
        for view, region in regions.items()
        if _pales_downwards(photos[view], region) or _is_far(means, cameras[[view]], region)
    }
    return shown if len(shown) >= max(LEAST_VIEWS, LEAST_SHARE * len(photos)) else {}


def _mostly_inside(gaussians: Gaussians, cameras: Cameras, regions: Mapping[int, np.ndarray]) -> np.ndarray:
    """Return a mask ``[n]`` of Gaussians that have most of their blending weights inside the views' regions."""
    splats = make_splats(gaussians)
    inside, total = np.zeros(len(splats)), np.zeros(len(splats))
    for view, region in regions.items():
        viewmat, K = cameras.viewmats[view].astype(np.float64), cameras.Ks[view].astype(np.float64)
        weights = view_weights(tile_view(splats, viewmat, K, cameras.width, cameras.height, near=NEAR_PLANE))
        sums = apply_transposed(weights, np.stack([region, np.ones_like(region)], 2).astype(np.float32))
        inside[weights.ids] += sums[:, 0]
        total[weights.ids] += sums[:, 1]
    return np.asarray((inside > 0) & (inside >= AGREEMENT * total))


def _is_far(means: np.ndarray, camera: Cameras, region: np.ndarray) -> bool:
    """Return whether a region ``[h,w]`` shows things several times as far away as the rest of the picture."""
    (pixels,), (depths,) = project(means[:: max(1, -(-len(means) // MAX_SAMPLE_GAUSSIANS))], camera)
    inside = (depths > 0) & is_inside(pixels, camera)
    x, y = pixels[inside].astype(int).T
    hit, depths = region[y, x], depths[inside]
    return bool(hit.any() and not hit.all() and np.median(depths[hit]) > FAR * np.median(depths[~hit]))


def sky_region(photo: np.ndarray) -> np.ndarray:
    """Return a mask ``[h,w]`` of smooth blue or white regions at a photo's upper border; empty if they are small."""
    height, width = photo.shape[:2]
    scale = max(height, width) / SIDE
    sigma = max(1.5 * scale, 0.5)
    upper = photo[: round(4 * sigma) + 3]  # what the upper border depends on
    if _like_sky(blur(upper, sigma), scale)[0].mean() < LEAST_TOP:
        return np.zeros((height, width), bool)
    soft = blur(photo, sigma)
    _, labels = cv2.connectedComponents(_like_sky(soft, scale).astype(np.uint8), connectivity=4)
    region = np.isin(labels, np.setdiff1d(labels[0], 0))
    warm = region.mean() < LEAST_AREA or np.percentile((soft[..., 2] - soft[..., 0])[region], 10) < -WARM
    return np.zeros_like(region) if warm else region


def _like_sky(soft: np.ndarray, scale: float) -> np.ndarray:
    """Return a mask ``[h,w]`` of what is smooth and blue or white in a blurred photo."""
    right, down = (reduce(np.maximum, np.moveaxis(np.abs(slope), 2, 0)) / 8 for slope in sobel(soft))
    red, green, blue = colors = np.moveaxis(soft, 2, 0)
    bright, dark = reduce(np.maximum, colors), reduce(np.minimum, colors)  # a tenth of the time of max(2)
    is_blue = (blue >= red) & (blue >= green - 0.02) & (bright > DARK)
    is_white = (bright > WHITE) & (bright - dark < GREY)
    return np.asarray((np.sqrt(right * right + down * down) * scale < SMOOTH) & (is_blue | is_white))


def _pales_downwards(photo: np.ndarray, region: np.ndarray) -> bool:
    """Return whether the colours of a region lose saturation towards the picture's lower border."""
    colors, rows = photo[region], np.nonzero(region)[0]
    bright = colors.max(1)
    saturation = (bright - colors.min(1)) / np.maximum(bright, 1e-6)
    low, high = np.percentile(saturation, (10, 90))
    if high - low < PALER_RANGE or np.ptp(rows) == 0:
        return False
    return bool(correlation(rows, saturation) <= PALER)
