"""Scene -> the scene in one exposure, if the exposures of its photos and Gaussians differ at random.

Cameras choose exposure and white balance for each photo, and models copy both into the colours of their Gaussians, so
one surface has several tones. Pixels of a view are looked up in other views that have Gaussians at the same depth. The
ratio of two views is the median ratio, in each channel, of the colours of pixels that show one place. The gains of all
views follow from the ratios of all pairs of views by least squares, with a geometric mean of one.

Gains are removed if nothing predicts the gain of a new view, so that the mean of all gains is the best guess. Photos
stay unchanged in two cases, in which the gain can be predicted. First, a camera that meters light makes bright places
darker, also in new photos. Among photos of a metering camera, photos with larger gains are not brighter. Second,
exposure may drift along a video, so that neighbouring photos have nearly the same gain. In these cases unchanged photos
are nearer to new photos than photos of mean exposure are, by 1.5 dB in a video of a kitchen.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmerge.frozen import replace
from gsmerge.method.geometry.transforms import (
    camera_distances,
    correlation,
    medians,
    order_others,
    rgb_to_sh0,
    sh0_to_rgb,
)
from gsmerge.method.kernels.elementary import exp, log
from gsmerge.prepare.photo_change import CLIPPED, PhotoChange, change_large
from gsmerge.prepare.surfaces import LEAST_SHARED, Ratio, collect_surfaces, solve_gains
from gsmerge.runtime.record import note, record_choices
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.stages import Exposure
from gsmerge.types import PicturedScene

EXPOSURE_PIXELS = 2000  # pixels of a view that are looked up in the other views
# colours in between are neither noise nor clipped
NOISE_LEVEL = 0.05
CLIPPED_LEVEL = 0.95
# The bounds from DIFFERENT to UNEXPECTED were chosen on the exports of 15 captures whose exposures were not changed.
# Exposures differ if the root mean square of the logarithmic gains is above DIFFERENT. It is above DIFFERENT in six of
# these 15 captures, and in nine of ten cases if five photos get random gains of 0.8 to 1.25
DIFFERENT = 0.06
# Brightness follows gains if the slope of photos' brightness over their gains, both as logarithms, is above FOLLOWS.
# The slope is 0.61 to 1.11 for random gains of 0.5 to 2, and at most 0.41 if a camera metered light and logarithmic
# gains are 0.1 or more. If the brightness of places varies more than the gains, the slope says little. So for a
# metering camera, the correlation of gains and the brightness of places must also be below OPPOSED; it is -0.67 to
# -0.99 for cameras that metered light
FOLLOWS = 0.5
OPPOSED = -0.6
# Gains are unexpected if share_unexpected returns more than UNEXPECTED. For random gains of 0.5 to 2 the function
# returns 0.71 to 1.22, or 0.67 for four views in a row. If exposure drifts, share_unexpected returns 0.19 to 0.57, and
# results lose 1.7 dB or more if gains are removed
UNEXPECTED = 0.69
COARSE_STEP = 4  # the brightness of a photo is measured on every COARSE_STEP-th pixel of every COARSE_STEP-th row
BRIGHT_GAIN = 1.15  # clipped pixels do not count in photos with a gain above BRIGHT_GAIN
CLIPPED_NEIGHBOURS = 8  # views in which the surfaces of clipped pixels are looked up


def equalise_exposure(scene: PicturedScene, views: Sequence[int], exposure: Exposure) -> tuple[PicturedScene, str]:
    """Divide each view's photo and its pixels' Gaussians by the exposure gain of the view, if that is needed.

    The photos of ``views`` show the scene. Gaussians that belong to no view keep their colours. Clipped pixels of
    brighter photos no longer count if another photo shows their surface unclipped. Also returns a sentence that says
    so, "" if nothing changes. The record of the run gets the choice ``exposure``, the gain of each view in red, green
    and blue. If exposures differ but photos stay unchanged, a note says why.
    """
    if exposure == "fixed" or len(views) < 2:
        return scene, ""
    pairs = _measure_pairs(scene, views)
    gains = solve_gains(pairs, len(scene))
    factors = exp(gains).round(3)
    low = factors.min()
    high = factors.max()
    if low == high:
        return scene, ""
    differ = f"the same surfaces differ in brightness by factors of {low:.2f} to {high:.2f} between photos"
    if exposure == "auto":
        view_gains = gains[list(views)]
        photos = [scene.images[view][::COARSE_STEP, ::COARSE_STEP] for view in views]
        if root_mean_square(view_gains) < DIFFERENT:
            return scene, ""
        brightness = log(np.maximum([photo.mean((0, 1), dtype=np.float64) for photo in photos], 1 / 255))
        objection = ""
        if is_metered(brightness, view_gains):
            objection = "this looks like automatic exposure (photos with larger factors are not brighter)"
        elif share_unexpected(view_gains, camera_distances(scene.cameras[list(views)])) < UNEXPECTED:
            objection = "neighbouring photos have nearly the same exposure, so new views between them have it, too"
        if objection:
            remedy = "--set exposure=per-photo brings them to their mean exposure"
            note(f"{differ}; photos stay unchanged, because {objection}; {remedy}")
            return scene, ""
    record_choices(exposure=factors.tolist())
    with_rows = "photos, and the Gaussians of their pixels," if scene.has_own_pixels else "photos"
    change = f"{differ}: {with_rows} are brought to their mean exposure"
    return _divide_by_gains(scene, factors), change


def root_mean_square(gains: np.ndarray) -> float:
    """Compute the root mean square of logarithmic gains ``[v,3]`` about their mean."""
    away = gains - gains.mean(0)
    return float(np.sqrt((away * away).mean()))


def is_metered(brightness: np.ndarray, gains: np.ndarray) -> bool:
    """Return True if the gains look like those of a camera that meters light, and so makes all photos equally bright.

    ``brightness [v,3]`` of the photos and ``gains [v,3]`` are logarithms. If gains are random, photos with larger gains
    are brighter; if light was metered, they are not.
    """
    gains = gains - gains.mean(0)
    brightness = brightness - brightness.mean(0)
    slope = float((gains * brightness).sum() / max((gains * gains).sum(), 1e-12))
    return slope < FOLLOWS and correlation(gains.ravel(), (brightness - gains).ravel()) < OPPOSED


def share_unexpected(gains: np.ndarray, distances: np.ndarray) -> float:
    """Measure the RMS distance of views' gains from the mean gains of their two nearest views.

    The result is divided by the distance that is expected of random gains, so the result is about 1 for random gains
    and less if neighbours have similar gains. ``gains [v,3]`` are logarithms; ``distances [v,v]`` are between cameras.
    """
    nearest = order_others(distances)[:, :2]
    offsets = gains - gains[nearest].mean(1)
    expected = root_mean_square(gains) * np.sqrt(len(gains) / (len(gains) - 1) * (1 + 1 / nearest.shape[1]))
    return float(np.sqrt((offsets * offsets).mean()) / max(expected, 1e-9))


def _measure_pairs(scene: PicturedScene, views: Sequence[int]) -> list[Ratio]:
    """Measure the ratios of colours between pairs of ``views`` that show the same surfaces."""
    photos = scene.images.reshape(len(scene), scene.pixels_per_view, 3)

    def measure(view: int, other: int, rows: np.ndarray, other_rows: np.ndarray) -> Ratio | None:
        """Measure the ratio of colours between two views."""
        here = photos[view].take(rows, axis=0)
        there = photos[other].take(other_rows, axis=0)
        red, green, blue = (
            (here > NOISE_LEVEL) & (here < CLIPPED_LEVEL) & (there > NOISE_LEVEL) & (there < CLIPPED_LEVEL)
        ).T
        usable = red & green & blue
        if usable.sum() < LEAST_SHARED:
            return None
        ratios = log(there[usable].astype(np.float64) / here[usable])
        return Ratio(view, other, medians(ratios), len(ratios))

    return collect_surfaces(scene).compare(views, EXPOSURE_PIXELS, measure)


def _divide_by_gains(scene: PicturedScene, gains: np.ndarray) -> PicturedScene:
    """Divide photos and colours of Gaussians by ``gains [v,3]``, which are factors of exposure.

    Clipped pixels of brighter photos are masked if another photo shows their surface unclipped. A surface that is
    clipped in all photos, such as a sky, is not masked, because otherwise no photo would show it.
    """
    clipped = ((scene.images >= CLIPPED) & (gains[:, None, None] > BRIGHT_GAIN)).any(-1)
    surfaces = collect_surfaces(scene)
    flat = clipped.reshape(len(scene), -1)
    order = order_others(camera_distances(scene.cameras))[:, :CLIPPED_NEIGHBOURS]
    shown = parallel_map(lambda view: surfaces.find_shown(view, flat[view], order[view], ~flat), range(len(scene)))
    masks = ~np.stack(shown).reshape(clipped.shape)
    if scene.masks is not None:
        masks &= scene.masks
    factors = (1 / gains).astype(np.float32)
    levels = np.arange(256, dtype=np.float32) / np.float32(255)
    changes = [PhotoChange(tones=(factor[:, None] * levels).clip(0, 1)) for factor in factors]
    images = np.empty_like(scene.images)

    def divide(view: int) -> None:
        images[view] = (scene.images[view] * factors[view]).clip(0, 1)

    parallel_map(divide, range(len(scene)))
    gaussians = scene.gaussians
    if scene.has_own_pixels:
        row_factors = factors[scene.get_pixels().homes // scene.pixels_per_view][:, None]
        sh0 = rgb_to_sh0(sh0_to_rgb(gaussians.sh0) * row_factors).astype(np.float32)
        gaussians = replace(gaussians, sh0=sh0, shN=gaussians.shN * row_factors)
    large = None if scene.large_photos is None else change_large(scene.large_photos, changes)
    new_masks = scene.masks if masks.all() else masks
    return replace(scene, images=images, gaussians=gaussians, masks=new_masks, large_photos=large)
