"""Make the photos of a fit at the size of the views, at half of it, and larger if the files are larger."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from gsmerge.method.kernels.elementary import exp, log
from gsmerge.method.raster.metrics import decibels
from gsmerge.method.raster.photos import Photos, scene_photos, with_pixel_values
from gsmerge.method.raster.tiled_view import EPS2D
from gsmerge.runtime.record import note, record_choices
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.fit import FitOptions
from gsmerge.types import PicturedScene, Scene

MIN_AUTO_SCALE = 1.25  # if photos are larger than the views by a smaller factor, "auto" keeps the size of the views
MAX_GAIN = 2.0  # largest factor of exposure that a score compensates
PATCH_PIXELS = 32  # largest side of a held-out patch, pixels
HIDDEN_WEIGHT = np.float32(1e-9)  # weight of pixels that do not count, because 0 marks held-out pixels


def fit_photos(scene: PicturedScene, options: FitOptions, views: Sequence[int] | None = None) -> tuple[Photos, ...]:
    """Return the photos at full size, at half size, and larger if ``photo_scale`` is above 1.

    The photos belong to ``views``, or to all views if ``views`` is None. The larger size is recorded, and a note says
    that it takes time.
    """
    views = range(len(scene)) if views is None else views
    photos = _with_empty(scene_photos(scene), scene)[views], _with_empty(scene_photos(scene, 2), scene)[views]
    scale = 1.0 if options.photo_scale == "auto" else options.photo_scale
    if scale == 1:
        return photos
    large = _with_empty(large_photos(scene, scale), scene)[views]
    size = f"{large.width} x {large.height}"
    record_choices(photo_scale=round(scale, 4))
    note(
        f"the photos are larger than the views of {photos[0].width} x {photos[0].height}: the fit looks at them at"
        f" {size} as well, which takes time; --set photo_scale=1 does without"
    )
    return *photos, large


def _with_empty(photos: Photos, scene: PicturedScene) -> Photos:
    """Return the photos with a mask of the pixels in which the scene is empty, which a fit treats as background."""
    if scene.empty is None:
        return photos
    size = photos.width, photos.height
    shares = [cv2.resize((mask * 255).astype(np.uint8), size, interpolation=cv2.INTER_AREA) for mask in scene.empty]
    empty = np.stack(shares) / np.float32(255)
    weights = None if photos.weights is None else np.maximum(photos.weights, empty)
    return replace(photos, weights=weights, empty=empty)


def photo_scale(scene: Scene, options: FitOptions, *, auto: bool) -> tuple[float, str | None]:
    """Choose the size of the photos in a fit as a multiple of the views' size, at least 1.

    Also returns a reason if the size is smaller than the option asks for, else None. With the option "auto", the size
    is above 1 only if ``auto`` is true.
    """
    requested = options.photo_scale
    largest = largest_scale(scene)
    can_enlarge = options.fit == "full" and options.half_res_part < 1
    if requested == "auto":
        enlarges = can_enlarge and auto and largest >= MIN_AUTO_SCALE
        auto_scale = 2.0  # largest scale of "auto": more pixels take more time, and larger photos are rarely sharp
        return (min(largest, auto_scale) if enlarges else 1.0), None
    if requested == 1:
        return 1.0, None
    if not can_enlarge:
        need = "larger photos need the full fit, with steps on photos of full size"
        return 1.0, f"photo_scale {requested:g} is 1: {need}"
    tolerance = 0.01  # rounding of sizes to whole pixels may change a scale by this share
    if requested > largest * (1 + tolerance):
        return largest, f"photo_scale {requested:g} is {largest:.3g}: the photos are no larger"
    return float(min(requested, largest)), None


def largest_scale(scene: Scene) -> float:
    """Return the size of the photo files as a multiple of the views' size, at least 1."""
    large = scene.large_photos
    if large is None or len(scene) == 0:
        return 1.0
    focals = (0, 1), (0, 1)
    return max(1.0, float((large.Ks[0][focals] / scene.cameras.Ks[0][focals]).min()))


def large_photos(scene: Scene, scale: float) -> Photos:
    """Read the photos at ``scale`` times the views' size; ``scale`` is at most :func:`largest_scale`.

    The pictures are uint8, because they may take as much memory as the scene. The photos are compared with renders that
    have the low-pass filter of a viewer at the photos' size. Raises ValueError if the scene has no larger photos.
    """
    large = scene.large_photos
    cameras = scene.cameras
    if large is None:
        raise ValueError("expected a scene with photos larger than its views, got one without")
    focals = (0, 1), (0, 1)
    shares = scale * cameras.Ks[0][focals] / large.Ks[0][focals]
    width, height = (max(1, round(side * by)) for side, by in zip((large.width, large.height), shares, strict=True))

    def read(photo: int) -> np.ndarray:
        return np.asarray(cv2.resize(large.read(photo), (width, height), interpolation=cv2.INTER_AREA), np.uint8)

    Ks = large.Ks * np.array([[width / large.width], [height / large.height], [1.0]])
    pictures = np.stack(parallel_map(read, large.ids))
    return with_pixel_values(
        Photos(pictures, cameras.viewmats.astype(np.float64), Ks, EPS2D, antialiased=cameras.antialiased), scene
    )


def training_weights(photos: Photos, share: float, seed: int) -> list[np.ndarray]:
    """Return the weights ``[h,w]`` float32 of the pixels of each view in training: 0 on held-out patches.

    The share ``share`` of the patches is held out. If several patches of a photo have pixels that count, at least one
    of these patches is held out. Outside of held-out patches, pixels have the weights of the photo.
    Pixels with a weight below 1 are not held out, and a weight of 0 is replaced by ``HIDDEN_WEIGHT``.
    """
    size = max(1, min(PATCH_PIXELS, min(photos.height, photos.width) // 4))
    shape = -(-photos.height // size), -(-photos.width // size)
    training_weights = []
    for view in range(len(photos)):
        random = np.random.default_rng([seed, view])
        counting = np.ones(shape, bool)  # patches in which a pixel of weight 1 shows the scene
        if photos.weights is not None:
            counts = photos.weights[view] == 1
            if photos.empty is not None:
                counts &= photos.empty[view] == 0
            rows, columns = (np.arange(0, side, size) for side in counts.shape)
            counting = np.logical_or.reduceat(np.logical_or.reduceat(counts, rows, 0), columns, 1)
        held_out = (random.random(shape) < share) & counting
        if counting.any() and not held_out.any():  # hold out a random patch, unless it is the only one
            candidates = np.argwhere(counting)  # [p,2] row and column of patches
            patch = [random.integers(side) for side in shape] if counting.all() else random.choice(candidates)
            held_out[tuple(patch)] = len(candidates) > 1
        in_training = np.repeat(np.repeat(~held_out, size, 0), size, 1)[: photos.height, : photos.width]
        weights = in_training.astype(np.float32)
        if photos.weights is not None:
            given = photos.weights[view]
            weights = np.where(given == 1, weights, np.maximum(given, HIDDEN_WEIGHT))
        training_weights.append(weights)
    return training_weights


def reduced(weights: list[np.ndarray], photos: Photos) -> list[np.ndarray]:
    """Return weights for half-size ``photos``, from every second pixel of the full-size ``weights``."""
    return [np.ascontiguousarray(weight[::2, ::2][: photos.height, : photos.width]) for weight in weights]


def holdout_psnr(images: Sequence[np.ndarray], photos: Photos, weights: list[np.ndarray], min_gain: float) -> float:
    """Return the PSNR (dB) of renders on the held-out patches, where ``weights [h,w]`` are 0.

    Renders are brought to the exposures of their photos, if some exposure differs by the factor ``min_gain``. The
    factor of exposure of a view and channel is the least-squares solution on the weighted pixels, from ``1 / MAX_GAIN``
    to ``MAX_GAIN``. The factors of a channel are then divided by their geometric mean.
    """
    views = range(len(photos))
    clipped = parallel_map(lambda view: np.clip(images[view], 0, 1), views)

    def view_gains(view: int) -> np.ndarray:
        """Return the factors of exposure ``[3]`` of one view."""
        image = clipped[view]
        weight = weights[view][..., None]
        photo_products, image_squares = (
            [channel.sum(dtype=np.float64) for channel in np.moveaxis(weight * picture * image, -1, 0)]
            for picture in (photos.images[view], image)
        )
        return np.clip(photo_products / np.maximum(image_squares, 1e-9), 1 / MAX_GAIN, MAX_GAIN)

    all_gains = np.stack(parallel_map(view_gains, views))
    all_gains /= exp(log(all_gains).mean(0))
    if np.abs(log(all_gains)).max() < log(min_gain):
        all_gains[:] = 1
    gains = all_gains.astype(np.float32)

    def sum_errors(view: int) -> tuple[float, float]:
        """Return the sum of the squared errors of a view's held-out pixels, and the number of these pixels."""
        red, green, blue = np.moveaxis((clipped[view] * gains[view] - photos.images[view]) ** 2, -1, 0)
        error = red + green + blue  # takes a tenth of the time of a sum along the last axis
        mask = weights[view] == 0
        return float(error[mask].sum(dtype=np.float64)), float(mask.sum())

    error, count = np.sum(parallel_map(sum_errors, views), axis=0)
    return decibels(error / max(3 * count, 1))
