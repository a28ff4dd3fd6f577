"""Find results that are clearly worse than their input, in pictures that no fit has seen.

The input differs from the photos by its error. A result that differs from the input by more than twice this error has
itself a larger error than the input, by the triangle inequality. This test finds bad results whatever their cause is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmerge.io.photo_files import limit_size
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.fit.outside import outside_cameras, sample_gaussians
from gsmerge.method.geometry.views import even_views, resize_cameras
from gsmerge.method.kernels.pictures import blur
from gsmerge.method.raster import render
from gsmerge.method.raster.metrics import decibels
from gsmerge.method.raster.photos import shrink_pictures
from gsmerge.method.viewpoints.place_cameras import OUTSIDE_HIGH, OUTSIDE_LOW, between_cameras
from gsmerge.runtime.record import stage
from gsmerge.types import Cameras, Gaussians, PicturedScene

WRONG_DB = 20.0  # PSNR below which pictures look wrong; errors are then a tenth of the range of colours
TWICE_DB = decibels(1 / 4)  # dB between two errors of which one is twice the other (root mean square)
# Input and result are compared in small pictures: DISTANCE_PIXELS is their longer side, and a sample of
# DISTANCE_GAUSSIANS stands for the input. The pictures are blurred by a standard deviation of DISTANCE_BLUR pixels, so
# that noise of single Gaussians hardly counts. On fifteen captures, every result is nearer to its input than the input
# is to the photos, by .2 dB or more. Measuring takes .03 s
DISTANCE_GAUSSIANS = 40_000
DISTANCE_PIXELS = 80
DISTANCE_BLUR = 1.0
# most photos that are compared, and most cameras that are placed between views
MOST_PHOTOS = 2
MOST_BETWEEN = 3


def is_clearly_worse(input_psnr: float | None, result_psnr: float | None) -> bool:
    """Return whether a result has more than twice the error of its input and looks wrong, by their PSNR (dB).

    False if one of the two PSNR could not be measured.
    """
    # NaN is not less than any number
    return input_psnr is not None and result_psnr is not None and result_psnr < min(input_psnr - TWICE_DB, WRONG_DB)


@stage("input")
def describe_clear_loss(gaussians: Gaussians, prepared: Prepared) -> str | None:
    """Say that a result is clearly worse than its input between the views or in left-out pixels; None if it is not.

    ``gaussians`` are the canonical Gaussians of the result. The scene has photos.
    """
    scene = prepared.scene
    views = prepared.reference.score_views
    photo_views = [views[i] for i in even_views(len(views), min(len(views), MOST_PHOTOS))]
    size = limit_size((scene.cameras.width, scene.cameras.height), DISTANCE_PIXELS)
    sample = sample_gaussians(scene, DISTANCE_GAUSSIANS)
    cameras = resize_cameras(scene.cameras, *size)
    between = between_cameras(cameras[list(views)]) if len(views) > 1 else cameras[[]]
    if len(between) > 0:
        between = between[even_views(len(between), min(len(between), MOST_BETWEEN))]
    else:  # all views have the same place, so the cameras are placed beside them
        between = outside_cameras(sample.means, cameras, MOST_BETWEEN, OUTSIDE_LOW, OUTSIDE_HIGH)
    psnr = _measure_left_out(gaussians, scene, cameras, photo_views)
    if psnr is not None and psnr < WRONG_DB:  # most results look right there, so the input need not be drawn
        input_psnr = _measure_left_out(sample, scene, cameras, photo_views)
        if is_clearly_worse(input_psnr, psnr):
            return (
                "where photos do not count, the result differs from what belongs there more than twice as much as the"
                f" input does: {psnr:.1f} dB, {input_psnr:.1f} dB"
            )
    psnr_to_input = _measure_psnr(sample, between, render(gaussians, between).images, None)
    if not psnr_to_input < WRONG_DB:  # most results look right, so the photos need not be read
        return None
    photos = shrink_pictures(scene.images[photo_views], *size)
    masks = None if scene.masks is None else shrink_pictures(scene.masks[photo_views].astype(np.float32), *size) == 1
    photo_psnr = _measure_psnr(sample, cameras[photo_views], photos, masks)
    if not is_clearly_worse(photo_psnr, psnr_to_input):
        return None
    return (
        "between the views, pictures of the result differ from pictures of the input more than twice as much as these"
        f" differ from the photos: {psnr_to_input:.1f} dB, {photo_psnr:.1f} dB"
    )


def _measure_left_out(
    gaussians: Gaussians, scene: PicturedScene, cameras: Cameras, views: Sequence[int]
) -> float | None:
    """Return the PSNR (dB) of renders, over black or white, in pixels that masks leave out; None without such pixels.

    The lower of the two PSNR is returned, because a halo in the colour of the background does not show over it.
    """
    if scene.empty is None or scene.masks is None:
        return None
    size = cameras.width, cameras.height
    left_out_pixels = ~scene.masks[views]
    if scene.beyond is not None:  # nothing is known there
        left_out_pixels &= ~scene.beyond[views]
    left_out = shrink_pictures(left_out_pixels.astype(np.float32), *size) == 1
    if not left_out.any():
        return None
    pictures = shrink_pictures(scene.images[views], *size)
    empty = shrink_pictures(scene.empty[views], *size)
    drawn = render(gaussians, cameras[views])
    errors = (drawn.images - pictures)[left_out]
    on_white = errors + (1 - drawn.alphas - empty[..., None])[left_out]
    return decibels(float(max((errors**2).mean(), (on_white**2).mean())))


def _measure_psnr(gaussians: Gaussians, cameras: Cameras, pictures: np.ndarray, masks: np.ndarray | None) -> float:
    """Return the PSNR (dB) of renders of Gaussians against ``pictures [v,h,w,3]``, both blurred.

    Only pixels that the Gaussians cover are compared, and only where ``masks [v,h,w]`` is true, if it is given. NaN
    if no pixel is compared.
    """
    renders = render(gaussians, cameras)
    compared = (renders.alphas[..., 0] > 0.5) & (masks is None or masks)
    errors = [
        ((blur(image.clip(0, 1), DISTANCE_BLUR) - blur(picture.clip(0, 1), DISTANCE_BLUR)) ** 2)[pixels]
        for image, picture, pixels in zip(renders.images, pictures, compared, strict=True)
    ]
    return decibels(float(np.concatenate(errors).mean())) if compared.any() else np.nan
