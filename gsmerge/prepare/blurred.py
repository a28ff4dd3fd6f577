"""Scene with photos -> the scene without blurred photos, where sharper ones show the same surfaces.

The same surface has less local contrast in a photo that the hand shook, or that is out of focus. The ratio of two
photos is the median ratio of their contrasts, at pixels that show one place; the sharpness of all photos follows from
the ratios of all pairs by least squares, as exposures do. Contrasts are relative to brightness, which exposures change.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from gsmerge.arrays import mean_columns
from gsmerge.frozen import replace
from gsmerge.method.geometry.transforms import camera_distances, median, order_others
from gsmerge.method.geometry.views import take_rows
from gsmerge.method.kernels.elementary import exp, log
from gsmerge.method.kernels.pictures import blur
from gsmerge.method.raster.photos import counting_pixels, row_pictures
from gsmerge.prepare.photo_change import LOOK_OF_PHOTOS
from gsmerge.prepare.surfaces import LEAST_SHARED, Ratio, Surfaces, collect_surfaces, solve_gains
from gsmerge.runtime.record import list_some
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import PicturedScene

LEAST_VIEWS = 4  # of fewer photos, most may be blurred
COMPARED_PIXELS = 2000  # of a photo, whose surfaces are looked up in other photos
LEAST_PAIRS = 3  # other photos with which a blurred one is compared
FINE = 1.0  # standard deviation of the blur that takes the fine contrast away, pixels
AROUND = 2.0  # standard deviation of the window in which contrast is measured, pixels
DARK = 0.05  # brightness that is added to the brightness of a place, sRGB: contrasts of dark places are noise
LEAST_CONTRAST = 0.02  # of the sharper of two photos
# Sharpness of a blurred photo, in medians of all. Sharp photos of fifteen captures have at least 0.49, because views
# differ in distance and geometry is wrong; photos that a hand shook have a third or less
BLURRED = 0.45
# A blurred photo has less contrast as a whole, too, unless it shows more texture than the others: if no photo has less
# than WHOLE of the median, none is blurred
WHOLE = 0.75
LINES = 4  # every LINES-th line shows the contrast of a photo as a whole
NEIGHBOURS = 8  # sharp photos in which the surfaces of blurred ones are looked up
SQUARE = np.ones((5, 5), np.uint8)


def leave_out_blurred(scene: PicturedScene) -> tuple[PicturedScene, np.ndarray | None, str]:
    """Leave out pixels of blurred photos whose surfaces sharper photos show, with the Gaussians of these pixels.

    Also returns these pixels ``[v,h,w]`` bool, None if no photo is blurred, and a sentence.
    """
    if scene.pixels is None:
        return scene, None, ""
    views = [
        view for view in scene.photo_views if scene.images[view].std() > LEAST_CONTRAST
    ]  # a black photo is not blurred
    if len(views) < LEAST_VIEWS:
        return scene, None, ""
    quick = np.array([_measure_fine(scene.images[view]) for view in views])
    if quick.min() > WHOLE * median(quick):
        return scene, None, ""
    surfaces = collect_surfaces(scene)
    ratios = _measure_ratios(scene, views, surfaces)
    sharpness = solve_gains(ratios, len(scene))[:, 0]
    sharpness -= median(sharpness[views])
    counts = np.bincount([ratio.view for ratio in ratios], minlength=len(scene))
    is_blurred = (sharpness < float(log(BLURRED))) & (counts >= LEAST_PAIRS)
    if not is_blurred.any():
        return scene, None, ""
    sharp = [view for view in views if not is_blurred[view]]
    order = order_others(camera_distances(scene.cameras))
    counting = counting_pixels(scene)
    gone = np.zeros_like(counting)
    for view in np.flatnonzero(is_blurred).tolist():
        nearest = [other for other in order[view].tolist() if other in sharp][:NEIGHBOURS]
        shown = surfaces.find_shown(view, counting[view].reshape(-1), nearest, surfaces.valid)
        closed = cv2.morphologyEx(shown.reshape(counting[view].shape).astype(np.uint8), cv2.MORPH_CLOSE, SQUARE)
        gone[view] = cv2.morphologyEx(closed, cv2.MORPH_OPEN, SQUARE) > 0
    gone &= counting
    names = list_some([scene.names[view] for view in np.flatnonzero(is_blurred)])
    least = exp(sharpness[is_blurred]).min()
    change = (
        f"{is_blurred.sum()} of {len(views)} photos are blurred (down to {100 * least:.0f} % of the usual contrast of"
        f" the same surfaces): left out where sharper photos show the same, {100 * gone[is_blurred].mean():.0f} % of"
        f" them ({names}; {LOOK_OF_PHOTOS})"
    )
    goes = np.zeros(len(scene.gaussians), bool)
    if scene.has_own_pixels:
        pictures = row_pictures(scene)
        goes = gone.reshape(-1)[scene.get_pixels().homes]
        for view in np.flatnonzero(is_blurred).tolist():
            own = median(_measure_contrast(pictures[view])[gone[view]])
            if own * BLURRED > median(_measure_contrast(scene.images[view])[gone[view]]):  # a sharper photo made them
                goes &= scene.get_pixels().homes // scene.pixels_per_view != view
    scene = replace(scene, masks=counting & ~gone)
    return take_rows(scene, np.flatnonzero(~goes)) if goes.any() else scene, gone, change


def _measure_contrast(picture: np.ndarray) -> np.ndarray:
    """Return the contrast ``[h,w]`` of each pixel of a picture ``[h,w,3]``, relative to its brightness."""
    grey = mean_columns(picture)
    fine = np.abs(grey - blur(grey, FINE))
    return np.asarray(blur(fine, AROUND) / (blur(grey, AROUND) + np.float32(DARK)))


def _measure_fine(photo: np.ndarray) -> float:
    """Return the mean second difference of pixels in every LINES-th line of a photo, relative to its brightness."""
    lines = mean_columns(photo[::LINES])
    return float(np.abs(np.diff(lines, 2, axis=1)).mean() / (lines.mean() + DARK))


def _measure_ratios(scene: PicturedScene, views: Sequence[int], surfaces: Surfaces) -> list[Ratio]:
    """Measure the ratios of contrasts between pairs of photos that show the same surfaces."""
    measured = parallel_map(lambda view: _measure_contrast(scene.images[view]).reshape(-1), views)
    contrasts = dict(zip(views, measured, strict=True))
    least = np.float32(0.1 * LEAST_CONTRAST)  # keeps logarithms finite

    def measure(view: int, other: int, rows: np.ndarray, other_rows: np.ndarray) -> Ratio | None:
        """Measure the ratio of contrasts between two views."""
        here = contrasts[view][rows]
        there = contrasts[other][other_rows]
        is_textured = np.maximum(here, there) > LEAST_CONTRAST
        if is_textured.sum() < LEAST_SHARED:
            return None
        values = log((there + least).astype(np.float64) / (here + least))[is_textured]
        return Ratio(view, other, np.array([median(values)]), len(values))

    return surfaces.compare(views, COMPARED_PIXELS, measure)
