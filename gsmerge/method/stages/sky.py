"""Find the Gaussians of the sky in photos, without a network or a download.

In a photo, the sky is a smooth region that begins at the upper border and is nowhere warmer than grey. The sky also
becomes paler towards the horizon. A cloudy sky may not become paler, so a region is also sky if it is several times as
far away as the rest. Ceilings and white walls may be smooth, grey and at the upper border as well. But ceilings and
walls seldom become paler, are seldom far away, and never do either in several views.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce

import cv2
import numpy as np

from gsmerge.method.geometry.transforms import correlation, is_inside, project
from gsmerge.method.kernels.pictures import blur, sobel
from gsmerge.method.kernels.raster.list_weights import LANES, collect, list_weights
from gsmerge.method.raster import make_splats
from gsmerge.method.raster.images import tile_camera
from gsmerge.types import Cameras, Gaussians

GRADIENT_PIXELS = 480.0  # gradients are measured in a photo with GRADIENT_PIXELS on its longer side
# Blue sky is brighter than DARK_SKY. White sky is brighter than WHITE_SKY, and has less chroma than GREY_SKY
DARK_SKY = 0.35
WHITE_SKY = 0.75
GREY_SKY = 0.12
FAR_RATIO = 3.0  # the sky is more than FAR_RATIO times as far away as the rest
# Least number of views that show sky, and their least share of all views. If fewer views show sky, it may be something
# else that looks like sky
LEAST_SKY_VIEWS = 2
LEAST_SKY_SHARE = 0.2
SKY_GAUSSIANS = 200_000  # the depths of at most this many Gaussians are compared


def sky(gaussians: Gaussians, cameras: Cameras, photos: np.ndarray) -> np.ndarray:
    """Return a mask ``[n]`` of the canonical Gaussians that contribute mostly to the sky of ``photos [v,h,w,3]``."""
    regions = sky_regions(gaussians.means, cameras, photos)
    mask = np.zeros(len(gaussians), bool)
    if not regions:
        return mask
    # There are at most max_rounds. A round that adds less than last_share of the sky so far is the last one
    max_rounds = 6
    last_share = 0.02
    for _ in range(max_rounds):  # each round finds Gaussians that were hidden behind the sky found before
        rows = np.flatnonzero(~mask)
        is_sky = _mostly_inside(gaussians[rows], cameras, regions)
        mask[rows[is_sky]] = True
        if is_sky.sum() < last_share * mask.sum():
            break
    return mask


def sky_regions(means: np.ndarray, cameras: Cameras, photos: np.ndarray) -> dict[int, np.ndarray]:
    """Return a mask ``[h,w]`` of the sky for each view that shows sky, or none at all if too few views do."""
    candidates = {view: region for view, photo in enumerate(photos) if (region := sky_region(photo)).any()}
    skies = {
        view: region
        for view, region in candidates.items()
        if _pales_downwards(photos[view], region) or _is_farther_than_rest(means, cameras[[view]], region)
    }
    return skies if len(skies) >= max(LEAST_SKY_VIEWS, LEAST_SKY_SHARE * len(photos)) else {}


def _mostly_inside(gaussians: Gaussians, cameras: Cameras, regions: Mapping[int, np.ndarray]) -> np.ndarray:
    """Return a mask ``[n]`` of the Gaussians with most of their blending weight inside the regions of the views."""
    splats = make_splats(gaussians)
    inside = np.zeros(len(splats))
    total = np.zeros(len(splats))
    for view, region in regions.items():
        tiled = tile_camera(splats, cameras, view)
        image = np.zeros((*region.shape, LANES), np.float32)
        image[..., 0] = region
        image[..., 1] = 1
        sums = np.zeros((len(tiled.ids), LANES))  # of each Gaussian's weights times the channels of the image
        collect(*list_weights(*tiled.lists, tiled.height, tiled.width), *tiled.lists[1:], image, sums)
        inside[tiled.ids] += sums[:, 0]
        total[tiled.ids] += sums[:, 1]
    min_share = 0.7  # least share of the blending weight of a Gaussian that lies inside
    return np.asarray((inside > 0) & (inside >= min_share * total))


def _is_farther_than_rest(means: np.ndarray, camera: Cameras, region: np.ndarray) -> bool:
    """Return true if a region ``[h,w]`` of a picture is several times as far away as the rest, by median depth."""
    (pixels,), (depths,) = project(means[:: max(1, -(-len(means) // SKY_GAUSSIANS))], camera)
    inside = (depths > 0) & is_inside(pixels, camera)
    x, y = pixels[inside].astype(int).T
    in_region = region[y, x]
    depths = depths[inside]
    if not in_region.any() or in_region.all():
        return False
    return bool(np.median(depths[in_region]) > FAR_RATIO * np.median(depths[~in_region]))


def sky_region(photo: np.ndarray) -> np.ndarray:
    """Return a mask ``[h,w]`` of smooth blue or white regions at a photo's upper border, if they are large enough."""
    height, width = photo.shape[:2]
    scale = max(height, width) / GRADIENT_PIXELS
    sigma = max(1.5 * scale, 0.5)
    upper = photo[: round(4 * sigma) + 3]  # the blurred upper border depends on these rows alone
    # the sky has at least these shares of the picture and of its upper border
    least_area = 0.02
    least_top = 0.4
    if _like_sky(blur(upper, sigma), scale)[0].mean() < least_top:
        return np.zeros((height, width), bool)
    soft = blur(photo, sigma)
    _, labels = cv2.connectedComponents(_like_sky(soft, scale).astype(np.uint8), connectivity=4)
    region = np.isin(labels, np.setdiff1d(labels[0], 0))
    max_warmth = 0.03  # largest difference of red from blue in nine tenths of the sky
    is_no_sky = region.mean() < least_area or np.percentile((soft[..., 2] - soft[..., 0])[region], 10) < -max_warmth
    return np.zeros_like(region) if is_no_sky else region


def _like_sky(soft: np.ndarray, scale: float) -> np.ndarray:
    """Return a mask ``[h,w]`` of the pixels of a blurred photo that are smooth and either blue or white.

    ``scale`` is the length of the photo's longer side in units of ``GRADIENT_PIXELS``.
    """
    right, down = (reduce(np.maximum, np.moveaxis(np.abs(slope), 2, 0)) / 8 for slope in sobel(soft))
    red, green, blue = colors = np.moveaxis(soft, 2, 0)
    # takes a tenth of the time of max(2)
    bright = reduce(np.maximum, colors)
    dark = reduce(np.minimum, colors)
    is_blue = (blue >= red) & (blue >= green - 0.02) & (bright > DARK_SKY)
    is_white = (bright > WHITE_SKY) & (bright - dark < GREY_SKY)
    max_gradient = 0.02  # largest gradient of a colour per pixel of a photo of GRADIENT_PIXELS
    return np.asarray((np.sqrt(right * right + down * down) * scale < max_gradient) & (is_blue | is_white))


def _pales_downwards(photo: np.ndarray, region: np.ndarray) -> bool:
    """Return true if the colours of a region lose saturation towards the lower border of the picture."""
    colors = photo[region]
    rows = np.nonzero(region)[0]
    bright = colors.max(1)
    saturation = (bright - colors.min(1)) / np.maximum(bright, 1e-6)
    low, high = np.percentile(saturation, (10, 90))
    # Least difference between percentiles 10 and 90 of the saturation, and largest correlation between saturation and
    # row. Rows are counted downwards
    min_spread = 0.08
    max_correlation = -0.12
    if high - low < min_spread or np.ptp(rows) == 0:
        return False
    return bool(correlation(rows, saturation) <= max_correlation)
