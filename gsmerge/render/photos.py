"""The input photos with their cameras, at full or reduced size, as the stages that render against them want them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import cv2
import numpy as np

from gsmerge.geometry import sh0_to_rgb
from gsmerge.kernels.raster.project import TILE
from gsmerge.render.composite import composite
from gsmerge.render.metrics import psnr
from gsmerge.render.view_plan import Splats, plan_view, prepare
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Gaussians, Scene

Score = TypeVar("Score")

NEAR = 0.01  # near plane of every render that is scored, in canonical units
ONE_AT_A_TIME = 400_000  # Gaussians; the plan of a view is as large as they are, so threads share one view instead
BLOCK = 2  # tiles per side of the blocks that scored_tiles chooses among
EPS2D = 0.3  # low-pass of the rasterizer, square pixels of the full-size image


@dataclass(frozen=True)
class Photos:
    """V photos of one size."""

    images: np.ndarray  # [v,h,w,3] float32, sRGB in [0, 1]; uint8 of photos larger than the grid, see image()
    viewmats: np.ndarray  # [v,4,4] world to camera
    Ks: np.ndarray  # [v,3,3] intrinsics at this size
    # Low-pass variance in square pixels of this size: it stays that of the full-size image, so that scales are judged
    # against the filter that they will be rendered with
    eps2d: float

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, views: Sequence[int]) -> Photos:
        """The photos of some views; of all, in order, without a copy."""
        ids = list(views)
        if ids == list(range(len(self))):
            return self
        return replace(self, images=self.images[ids], viewmats=self.viewmats[ids], Ks=self.Ks[ids])

    @property
    def height(self) -> int:
        """Rows."""
        return self.images.shape[1]

    @property
    def width(self) -> int:
        """Columns."""
        return self.images.shape[2]

    def image(self, view: int) -> np.ndarray:
        """``[h,w,3]`` photo, sRGB in [0, 1]."""
        image = self.images[view]
        return np.multiply(image, np.float32(1 / 255), dtype=np.float32) if image.dtype == np.uint8 else image

    def camera(self, view: int) -> dict[str, Any]:
        """The arguments that :func:`gsmerge.render.plan_view` needs to render into a photo."""
        return {
            "viewmat": self.viewmats[view],
            "K": self.Ks[view],
            "width": self.width,
            "height": self.height,
            "eps2d": self.eps2d,
        }


def scene_pictures(scene: Scene) -> np.ndarray:
    """``[v,h,w,3]`` photos, or pictures made of the Gaussians' base colours where there are none.

    Raises:
        ValueError: If there are no photos and the Gaussians are not one per pixel.
    """
    if scene.images is not None:
        return scene.images
    if not scene.aligned:
        raise ValueError("expected a scene with images")
    shape = (len(scene), scene.cameras.height, scene.cameras.width, 3)
    return sh0_to_rgb(scene.gaussians.sh0[:, 0]).clip(0, 1).reshape(shape)


def scene_photos(scene: Scene, level: float = 1) -> Photos:
    """The scene's photos, each side divided by ``level`` (area averages)."""
    if scene.images is None:
        raise ValueError("expected a scene with images")
    return photos_of(scene.images, scene.cameras, level)


def photos_of(images: np.ndarray, cameras: Cameras, level: float = 1) -> Photos:
    """Photos ``[v,h,w,3]`` of the cameras' size, each side divided by ``level`` (area averages)."""
    blank = blank_photos(cameras, level)
    if level == 1:
        return replace(blank, images=images)
    size = blank.width, blank.height
    small = np.stack(parallel_map(lambda image: cv2.resize(image, size, interpolation=cv2.INTER_AREA), images))
    return replace(blank, images=small)


def blank_photos(cameras: Cameras, level: float = 1) -> Photos:
    """Black photos, which take no memory, for what only needs the cameras; each side divided by ``level``."""
    viewmats, Ks = cameras.viewmats.astype(np.float64), cameras.Ks.astype(np.float64)
    w, h = cameras.width, cameras.height
    width, height = max(1, round(w / level)), max(1, round(h / level))
    black = np.broadcast_to(np.float32(0), (len(cameras), height, width, 3))
    sx, sy = width / w, height / h
    return Photos(black, viewmats, Ks * np.array([[sx], [sy], [1.0]]), EPS2D * sx * sy)


def photo_errors(
    gaussians: Gaussians | Splats,
    photos: Photos,
    score: Callable[[int, np.ndarray, np.ndarray], Score],
    views: Iterable[int] | None = None,
    *,
    near: float = NEAR,
    colors: np.ndarray | None = None,
    keep: Callable[[int], np.ndarray] | None = None,
    tiles: Callable[[int], np.ndarray | None] | None = None,
) -> list[Score]:
    """Render some Gaussians into the photos' cameras and score every picture, several views at once.

    Args:
        score: Called with the view, its render ``[h,w,3]`` float32 (not clipped) and the transmittance ``[h,w]``.
        views: Of the photos, in the order of the result; None: all.
        near: Near plane, in the Gaussians' unit.
        colors: ``[n,3]`` in place of the Gaussians' harmonics.
        keep: View -> ``[n]`` mask of the Gaussians that are drawn in it; None: all.
        tiles: View -> ``[lines,columns]`` mask of the tiles that are complete; None, or its result is: all.
    """
    splats = gaussians if isinstance(gaussians, Splats) else prepare(gaussians)

    def one_view(view: int) -> Score:
        shown, complete = (None if choose is None else choose(view) for choose in (keep, tiles))
        plan = plan_view(splats, **photos.camera(view), near=near, keep=shown, tiles=complete)
        return score(view, *composite(plan, colors))

    chosen = range(len(photos)) if views is None else views
    if len(splats) > ONE_AT_A_TIME:
        return [one_view(view) for view in chosen]
    return parallel_map(one_view, chosen)


def photo_psnr(
    gaussians: Gaussians | Splats, photos: Photos, views: Iterable[int], *, quarter: bool = False, **settings: Any
) -> float:
    """Mean over some views of the PSNR (dB) of their photos.

    Args:
        quarter: Of the :func:`scored_tiles` alone, for a quarter to a half of the time.
        settings: As of :func:`photo_errors`.
    """

    def tiles(view: int) -> np.ndarray | None:
        return scored_tiles(view, photos.width, photos.height) if quarter else None

    def score(view: int, image: np.ndarray, _: np.ndarray) -> float:
        return view_psnr(image, photos, view, quarter=quarter)

    return float(np.mean(photo_errors(gaussians, photos, score, views, tiles=tiles, **settings)))


def view_psnr(image: np.ndarray, photos: Photos, view: int, *, quarter: bool) -> float:
    """Return the PSNR (dB) of a photo, or a quarter of it, and its render ``[h,w,3]``, clipped in place."""
    tiles = scored_tiles(view, photos.width, photos.height) if quarter else None
    mask = None if tiles is None else tiles.repeat(TILE, 0).repeat(TILE, 1)[: photos.height, : photos.width]
    return psnr(np.clip(image, 0, 1, out=image), photos.images[view], mask)


def scored_tiles(view: int, width: int, height: int) -> np.ndarray | None:
    """``[lines,columns]`` bool: the quarter of a view's tiles that scenes are judged by; None: all of small views.

    One of every two by two blocks of 32 pixels, another one from view to view and from place to place.
    """
    lines, columns = -(-height // TILE), -(-width // TILE)
    if min(lines, columns) <= 3 * BLOCK:
        return None
    y, x = np.arange(lines)[:, None] // BLOCK, np.arange(columns) // BLOCK
    chosen: np.ndarray = (y % 2 * 2 + x % 2) == (view + x // 2 + 2 * (y // 2)) % 4
    return chosen


def render_photos(gaussians: Gaussians | Splats, photos: Photos, **settings: Any) -> list[np.ndarray]:
    """``[h,w,3]`` render of every photo, not clipped; ``settings`` as of :func:`photo_errors`."""
    return photo_errors(gaussians, photos, lambda _, image, __: image, **settings)
