"""Measure whether a result differs too much from its input in pictures that no fit has seen.

Photos show how far the input is from the truth. If a result is more than twice as far from the input, it is farther
from the truth than the input, by the triangle inequality. So this finds bad results whatever their cause is.
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

WRONG_DB = 20.0  # PSNR below which pictures look wrong; errors are then a tenth of the range of colours
TWICE_DB = decibels(1 / 4)  # dB between two errors of which one is twice the other (root mean square)
# A sample of so many Gaussians stands for the input. It is drawn with so many pixels on the longer side. Pictures are
# blurred by this standard deviation (pixels), so that noise of single Gaussians hardly counts. On fifteen captures all
# results are nearer to their input than the input to its photos, by .2 dB or more; measuring takes .03 s
DISTANCE_GAUSSIANS, DISTANCE_PIXELS, DISTANCE_BLUR = 40_000, 80, 1.0
MOST_PHOTOS, MOST_BETWEEN = 2, 3  # most photos that are compared, and most cameras that are placed between views


def is_far(near: float | None, far: float | None) -> bool:
    """Return whether ``far``, a PSNR (dB), means more than twice the error of ``near``, and looks wrong.

    False if one of them could not be measured.
    """
    return near is not None and far is not None and far < min(near - TWICE_DB, WRONG_DB)  # NaN is not less


@stage("input")
def describe_far(gaussians: Gaussians, prepared: Prepared) -> str | None:
    """Describe that canonical Gaussians lie far from the input of a scene with photos; None if they do not."""
    scene, views = prepared.scene, prepared.reference.score_views
    own = [views[i] for i in even_views(len(views), min(len(views), MOST_PHOTOS))]
    share = DISTANCE_PIXELS / max(DISTANCE_PIXELS, scene.cameras.width, scene.cameras.height)
    size = [max(1, round(side * share)) for side in (scene.cameras.width, scene.cameras.height)]
    sample, cameras = sample_gaussians(scene, DISTANCE_GAUSSIANS), resize_cameras(scene.cameras, *size)
    between = _place_between(sample, cameras, views)
    pictures = shrink_pictures(scene.images[own], *size)
    counts = None if scene.masks is None else shrink_pictures(scene.masks[own].astype(np.float32), *size) == 1
    distance = _measure_psnr(sample, between, render(gaussians, between).images, None)
    # the error of the input is only measured if the result looks wrong
    if not distance < WRONG_DB or not is_far(error := _measure_psnr(sample, cameras[own], pictures, counts), distance):
        return None
    return (
        "between the views, pictures of the result differ from pictures of the input more than twice as much as these"
        f" differ from the photos: {distance:.1f} dB, {error:.1f} dB"
    )


def _place_between(sample: Gaussians, cameras: Cameras, views: Sequence[int]) -> Cameras:
    """Place a few cameras between the views, or beside them if no two have space between them."""
    between = between_cameras(cameras[list(views)]) if len(views) > 1 else cameras[[]]
    if len(between) == 0:
        return outside_cameras(sample.means, cameras, MOST_BETWEEN, OUTSIDE_LOW, OUTSIDE_HIGH)
    return between[even_views(len(between), min(len(between), MOST_BETWEEN))]


def _measure_psnr(gaussians: Gaussians, cameras: Cameras, pictures: np.ndarray, counts: np.ndarray | None) -> float:
    """Return the PSNR (dB) of renders of Gaussians against ``pictures [v,h,w,3]``, both blurred.

    Only pixels that the Gaussians cover are compared and, if there is a mask ``counts [v,h,w]``, those inside it. NaN
    without such pixels.
    """
    drawn = render(gaussians, cameras)
    covered = (drawn.alphas[..., 0] > 0.5) & (counts is None or counts)
    pairs = zip(drawn.images, pictures, covered, strict=True)
    errors = [
        ((blur(a.clip(0, 1), DISTANCE_BLUR) - blur(b.clip(0, 1), DISTANCE_BLUR)) ** 2)[mask] for a, b, mask in pairs
    ]
    return decibels(float(np.concatenate(errors).mean())) if covered.any() else np.nan
