"""Result -> whether it lies far from its input in pictures that no fit has seen.

Photos tell how far the input is from the truth. A result that is farther from the input than twice that is farther from
the truth than the input is, by the triangle inequality. The cause may be one that no rule foresees.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmerge.facts.place_cameras import OUTSIDE_HIGH, OUTSIDE_LOW, between_cameras
from gsmerge.facts.prepare import Prepared
from gsmerge.fit.outside import outside_cameras, sample_gaussians
from gsmerge.kernels.pictures import blur
from gsmerge.photos.views import even_views, resize_cameras
from gsmerge.raster import render
from gsmerge.raster.metrics import decibels
from gsmerge.raster.photos import shrink_pictures
from gsmerge.runtime.record import stage
from gsmerge.types import Cameras, Gaussians

WRONG_DB = 20.0  # dB, which is a tenth of the range of colours (root mean square); from there on pictures look right
TWICE_DB = decibels(1 / 4)  # dB between two distances of which one is twice the other
# Gaussians that represent the input, pixels of the longer side, and standard deviation of a blur, pixels, by which
# noise of the Gaussians hardly counts. On fifteen captures a result is .2 dB or more nearer to its input than the input
# to its photos, and .03 s tell that
DISTANCE_GAUSSIANS, DISTANCE_PIXELS, DISTANCE_BLUR = 40_000, 80, 1.0
MOST_PHOTOS, MOST_BETWEEN = 2, 3  # most photos, and most cameras between them, that are compared


def is_far(near: float | None, far: float | None) -> bool:
    """Return whether a PSNR (dB) means twice the error of another, and looks wrong; False if one cannot be measured."""
    return near is not None and far is not None and far < min(near - TWICE_DB, WRONG_DB)  # NaN is not less


@stage("input")
def describe_far(gaussians: Gaussians, prepared: Prepared) -> str | None:
    """Describe that canonical Gaussians lie far from the input of a scene with photos; None if they do not."""
    scene, views = prepared.scene, prepared.reference.score_views
    own = [views[i] for i in even_views(len(views), min(len(views), MOST_PHOTOS))]
    share = DISTANCE_PIXELS / max(DISTANCE_PIXELS, scene.cameras.width, scene.cameras.height)
    size = [max(1, round(side * share)) for side in (scene.cameras.width, scene.cameras.height)]
    sample, cameras = sample_gaussians(scene, DISTANCE_GAUSSIANS), resize_cameras(scene.cameras, *size)
    more = _place_between(sample, cameras, views)
    pictures = shrink_pictures(scene.images[own], *size)
    counts = None if scene.masks is None else shrink_pictures(scene.masks[own].astype(np.float32), *size) == 1
    distance = _compare(sample, more, render(gaussians, more).images, None)
    # the second is only measured if the first does not look right
    if not distance < WRONG_DB or not is_far(error := _compare(sample, cameras[own], pictures, counts), distance):
        return None
    return (
        "between the views, pictures of the result differ from pictures of the input more than twice as much as these"
        f" differ from the photos: {distance:.1f} dB, {error:.1f} dB"
    )


def _place_between(sample: Gaussians, cameras: Cameras, views: Sequence[int]) -> Cameras:
    """Place a few cameras between views; if there is no space between any, beside them."""
    between = between_cameras(cameras[list(views)]) if len(views) > 1 else cameras[[]]
    if len(between) == 0:
        return outside_cameras(sample.means, cameras, MOST_BETWEEN, OUTSIDE_LOW, OUTSIDE_HIGH)
    return between[even_views(len(between), min(len(between), MOST_BETWEEN))]


def _compare(gaussians: Gaussians, cameras: Cameras, pictures: np.ndarray, counts: np.ndarray | None) -> float:
    """Return the PSNR (dB) of ``pictures [v,h,w,3]`` and drawings, both blurred, where Gaussians cover a pixel."""
    drawn = render(gaussians, cameras)
    covered = (drawn.alphas[..., 0] > 0.5) & (counts is None or counts)
    pairs = zip(drawn.images, pictures, covered, strict=True)
    errors = [
        ((blur(a.clip(0, 1), DISTANCE_BLUR) - blur(b.clip(0, 1), DISTANCE_BLUR)) ** 2)[mask] for a, b, mask in pairs
    ]
    return decibels(float(np.concatenate(errors).mean())) if covered.any() else np.nan
