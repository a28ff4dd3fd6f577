"""The input photos with their cameras, at full or reduced size, as the stages that render against them want them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from torch import Tensor

from gsmerge.runtime.threads import parallel_map
from gsmerge.types import SH_C0, Cameras, PixelScene, UnalignedScene

EPS2D = 0.3  # low-pass of the rasterizer, square pixels of the full-size image


@dataclass(frozen=True)
class Photos:
    """V photos of one size.

    Args:
        images: ``[v,h,w,3]`` float32, sRGB in [0, 1].
        viewmats: ``[v,4,4]`` world to camera.
        Ks: ``[v,3,3]`` intrinsics at this size.
        eps2d: Low-pass variance in square pixels of this size: it stays that of the full-size image, so that
            scales are judged against the filter that they will be rendered with.
    """

    images: np.ndarray
    viewmats: np.ndarray
    Ks: np.ndarray
    eps2d: float

    def __len__(self) -> int:
        return len(self.images)

    @property
    def height(self) -> int:
        """Rows."""
        return self.images.shape[1]

    @property
    def width(self) -> int:
        """Columns."""
        return self.images.shape[2]

    def camera(self, view: int) -> dict[str, Any]:
        """The arguments that :func:`gsmerge.render.plan_view` needs to render into a photo."""
        return {
            "viewmat": self.viewmats[view],
            "K": self.Ks[view],
            "width": self.width,
            "height": self.height,
            "eps2d": self.eps2d,
        }


def scene_pictures(scene: PixelScene | UnalignedScene) -> Tensor:
    """``[v,h,w,3]`` photos, or pictures made of the Gaussians' base colours where there are none.

    Raises:
        ValueError: If there are no photos and the Gaussians are not one per pixel.
    """
    if scene.images is not None:
        return scene.images
    if isinstance(scene, UnalignedScene):
        raise ValueError("expected a scene with images")
    shape = (len(scene), scene.cameras.height, scene.cameras.width, 3)
    return (0.5 + SH_C0 * scene.gaussians.sh0[:, 0]).clamp(0, 1).reshape(shape)


def scene_photos(scene: PixelScene | UnalignedScene, level: int = 1) -> Photos:
    """The scene's photos, each side divided by ``level`` (area averages).

    Raises:
        ValueError: If the scene has no images.
    """
    if scene.images is None:
        raise ValueError("expected a scene with images")
    return photos_of(scene.images.numpy(), scene.cameras, level)


def photos_of(images: np.ndarray, cameras: Cameras, level: int = 1) -> Photos:
    """Photos ``[v,h,w,3]`` of the cameras' size, each side divided by ``level`` (area averages)."""
    blank = blank_photos(cameras, level)
    if level == 1:
        return replace(blank, images=images)
    size = blank.width, blank.height
    small = np.stack(parallel_map(lambda image: cv2.resize(image, size, interpolation=cv2.INTER_AREA), images))
    return replace(blank, images=small)


def blank_photos(cameras: Cameras, level: int = 1) -> Photos:
    """Black photos, which take no memory, for what only looks at cameras; each side divided by ``level``."""
    viewmats, Ks = cameras.viewmats.double().numpy(), cameras.Ks.double().numpy()
    w, h = cameras.width, cameras.height
    size = (w, h) if level == 1 else (max(1, round(w / level)), max(1, round(h / level)))
    black = np.broadcast_to(np.float32(0), (len(cameras), size[1], size[0], 3))
    if level == 1:
        return Photos(black, viewmats, Ks, EPS2D)
    sx, sy = size[0] / w, size[1] / h
    return Photos(black, viewmats, Ks * np.array([[sx], [sy], [1.0]]), EPS2D * sx * sy)
