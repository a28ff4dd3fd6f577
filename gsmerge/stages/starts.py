"""How well Gaussians show the views before anything is fitted: what one start is preferred to another by."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from gsmerge.render import composite, plan_view, prepare
from gsmerge.render.photos import Photos, scene_photos, scene_pictures
from gsmerge.runtime.threads import parallel_map
from gsmerge.stages.prepare import NEAR
from gsmerge.types import Gaussians, PixelScene, UnalignedScene
from gsmerge.views import pick_views

MOST = 6  # views that are looked at


def views_psnr(gaussians: Gaussians, scene: PixelScene | UnalignedScene) -> float:
    """PSNR (dB) of the views at half size, over the pixels that have a Gaussian of their own.

    Args:
        gaussians: Canonical Gaussians.
        scene: The canonical scene; without photos, the colours of its pixels stand in for them.
    """
    photos, splats = _photos(scene), prepare(gaussians)

    def one_view(view: int) -> tuple[float, float]:
        image, _ = composite(plan_view(splats, **photos.camera(view), near=NEAR))
        error = ((np.clip(image, 0, 1) - photos.images[view]) ** 2).sum(-1)
        weight = _weight(scene, view, photos)
        return float((error * weight).sum(dtype=np.float64)), float(weight.sum(dtype=np.float64))

    error, count = np.sum(parallel_map(one_view, pick_views(len(photos), MOST)), axis=0)
    return float(-10 * np.log10(max(error / max(3 * count, 1), 1e-12)))


def _photos(scene: PixelScene | UnalignedScene) -> Photos:
    """The photos at half size, or the pictures that stand in for them."""
    if scene.images is None:
        scene = replace(scene, images=scene_pictures(scene).contiguous())
    return scene_photos(scene, 2)


def _weight(scene: PixelScene | UnalignedScene, view: int, photos: Photos) -> np.ndarray:
    """``[h,w]`` share of each half-size pixel that has Gaussians; ones where Gaussians belong to no pixels."""
    size = photos.width, photos.height
    if isinstance(scene, UnalignedScene):
        return np.ones(size[::-1], np.float32)
    return cv2.resize(scene.valid[view].numpy().astype(np.float32), size, interpolation=cv2.INTER_AREA)
