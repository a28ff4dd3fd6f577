"""Make small pictures of what Gaussians show from cameras, to compare them with photos.

Colours are divided by opacity, so faint or sparse Gaussians have the colours of solid ones. The opacity of a pixel is
its weight. Photos and pictures are averaged with these weights, so pixels without Gaussians count in neither.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.method.geometry.frame import Frame, canonicalise
from gsmerge.method.geometry.transforms import sh0_to_rgb
from gsmerge.method.raster.images import thin_out
from gsmerge.method.raster.photos import (
    LEAST_OPACITY,
    blank_photos,
    photo_errors,
    photos_of,
    pixel_weights,
    shrink_pictures,
)
from gsmerge.types import Cameras, Gaussians, Scene

PICTURE_GAUSSIANS = 1 << 17  # largest sample of Gaussians that is drawn
PICTURE_PIXELS = 96  # pixels of the longer side of pictures that photos are compared with
_CANONICAL = Frame(np.zeros(3), 1.0)  # frame of canonical scenes


@dataclass(frozen=True, eq=False)
class ViewPictures:
    """Small pictures of what the Gaussians show in v views."""

    pictures: np.ndarray  # [v,h,w,3] colours in [0, 1], as of solid Gaussians; 0 where nothing is shown
    weights: np.ndarray  # [v,h,w] opacity, in [0, 1]; 0 outside masks
    drawn: bool  # True for renders, which wrong depth displaces; False for colours of the Gaussians at their pixels

    def __len__(self) -> int:
        return len(self.pictures)

    def __getitem__(self, views: Sequence[int]) -> ViewPictures:
        """Select the pictures of ``views``."""
        ids = list(views)
        return replace(self, pictures=self.pictures[ids], weights=self.weights[ids])

    def shrink(self, side: int) -> ViewPictures:
        """Shrink the pictures, by weighted averages, to at most ``side`` pixels on the longer side."""
        width, height = fit_size(self.weights.shape[2:0:-1], side)
        weights = shrink_pictures(self.weights, width, height)
        return replace(self, pictures=average(self.pictures, self.weights, weights), weights=weights)


@dataclass(frozen=True, eq=False)
class Pairs:
    """Photos of v views, and pictures of the Gaussians from the same cameras."""

    photos: np.ndarray  # [v,h,w,3] at the size of the pictures
    shown: ViewPictures

    def __len__(self) -> int:
        return len(self.photos)

    def shrink(self, side: int) -> Pairs:
        """Shrink photos and pictures, by weighted averages, to at most ``side`` pixels on the longer side."""
        small = self.shown.shrink(side)
        return Pairs(average(self.photos, self.shown.weights, small.weights), small)

    def exchange(self) -> Pairs:
        """Return a copy with photos and pictures exchanged."""
        return Pairs(self.shown.pictures, replace(self.shown, pictures=self.photos))

    def with_photos(self, photos: np.ndarray) -> Pairs:
        """Return a copy with other ``photos``."""
        return replace(self, photos=photos)

    def __getitem__(self, views: Sequence[int]) -> Pairs:
        """Select the pairs of ``views``."""
        ids = list(views)
        return Pairs(self.photos[ids], self.shown[ids])


def fit_size(size: Sequence[int], side: int) -> tuple[int, int]:
    """Return width and height in the proportion of ``size``, with at most ``side`` pixels on the longer side."""
    reduction = max(1.0, max(size) / side)
    width, height = (max(1, round(full_side / reduction)) for full_side in size)
    return width, height


def average(pictures: np.ndarray, weights: np.ndarray, small: np.ndarray) -> np.ndarray:
    """Shrink pictures ``[v,h,w,3]`` by averages with ``weights [v,h,w]``; ``small [v,H,W]`` are the shrunk weights."""
    sums = shrink_pictures((pictures * weights[..., None]).astype(np.float32), small.shape[2], small.shape[1])
    return np.asarray(
        np.divide(sums, small[..., None], out=np.zeros_like(sums), where=small[..., None] > LEAST_OPACITY)
    )


def pair_photos(scene: Scene, photos: np.ndarray) -> Pairs:
    """Pair ``photos [v,h,w,3]`` with pictures of the Gaussians of a canonical scene."""
    shown = show_views(scene, frame=_CANONICAL)
    if scene.has_own_pixels:
        return Pairs(photos[_sample_grid(scene.cameras, PICTURE_PIXELS)], shown)
    reduction = max(1.0, max(scene.cameras.width, scene.cameras.height) / PICTURE_PIXELS)
    return Pairs(photos_of(photos, scene.cameras, reduction).images, shown)


def show_views(scene: Scene, side: int | None = None, frame: Frame | None = None) -> ViewPictures:
    """Make small pictures of what a scene's Gaussians show in its views.

    If each Gaussian belongs to one view, a view's picture has the colours of a sample of its Gaussians. If views share
    Gaussians, a picture is a render of a sample of all Gaussians. ``side`` is the number of pixels on the longer side,
    by default :data:`PICTURE_PIXELS`. ``frame`` is the canonical frame of the scene, if known.
    """
    if scene.has_own_pixels:
        return _show_rows(scene, PICTURE_PIXELS) if side is None else _show_rows(scene, 2 * side).shrink(side)
    sampled = Scene(thin_out(scene.gaussians, PICTURE_GAUSSIANS), scene.cameras, None, None, scene.names)
    canonical, _ = canonicalise(sampled, frame)
    shown = draw_canonical(canonical.gaussians, canonical.cameras, side or PICTURE_PIXELS)
    inside = pixel_weights(scene.masks, *shown.weights.shape[2:0:-1])
    return shown if inside is None else replace(shown, weights=shown.weights * (inside == 1))


def _show_rows(scene: Scene, side: int) -> ViewPictures:
    """Make pictures from the colours of the views' own Gaussians, with one of every few pixels.

    The longer side has at most ``side`` pixels.
    """
    grid = _sample_grid(scene.cameras, side)
    rows = scene.get_pixels().fronts[grid]
    weights = np.where(rows >= 0, scene.gaussians.opacities[rows], 0)
    if scene.masks is not None:
        weights = weights * scene.masks[grid]
    colors = sh0_to_rgb(scene.gaussians.sh0[rows, 0]).clip(0, 1)
    return ViewPictures(colors, weights.astype(np.float32), drawn=False)


def _sample_grid(cameras: Cameras, side: int) -> tuple[slice, slice, slice]:
    """Return slices of views, lines and columns that select pixels at equal steps, at most ``side`` on the longer side.

    The first pixel is in the middle of the first step.
    """
    step = -(-max(cameras.width, cameras.height) // side)
    pixels = slice(min(step // 2, cameras.width - 1, cameras.height - 1), None, step)
    return slice(None), pixels, pixels


def draw_canonical(gaussians: Gaussians, cameras: Cameras, side: int) -> ViewPictures:
    """Render canonical Gaussians at most ``side`` pixels wide and high, and divide colours by opacity."""
    blank = blank_photos(cameras, max(1.0, max(cameras.width, cameras.height) / side))
    renders = photo_errors(gaussians, blank, lambda _, image, transmittance: (image, 1 - transmittance))
    images, opacities = map(np.stack, zip(*renders, strict=True))
    pictures = np.divide(
        images, opacities[..., None], out=np.zeros_like(images), where=opacities[..., None] > LEAST_OPACITY
    )
    return ViewPictures(pictures.clip(0, 1), opacities, drawn=True)
