"""Sample what a training step uses of its examples: windows of photos, and the Feature Gaussians in these windows."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsmerge.frozen import dataclass
from gsmerge.method.raster import make_splats, tile_view
from gsmerge.method.raster.photos import NEAR_PLANE, Photos
from gsmerge.research.training.examples import Example
from gsmerge.types import Cameras

MIN_SIDE = 16  # least side of a halved window, pixels


@dataclass(frozen=True, eq=False)
class Crop:
    """A subset of an example's Feature Gaussians, which are decoded into K children each."""

    example: Example
    k: int  # number of children of each Feature Gaussian
    rows: np.ndarray  # [r] rows of the example's Feature Gaussians, ascending


@dataclass(frozen=True)
class Box:
    """A rectangle of a photo: first column and row, width and height, pixels."""

    left: int
    top: int
    width: int
    height: int

    def halved(self) -> Box:
        """Return the middle half of the box along its longer side, which keeps at least ``MIN_SIDE`` pixels."""
        if self.width >= self.height:
            width = max(min(MIN_SIDE, self.width), self.width // 2)
            return Box(self.left + (self.width - width) // 2, self.top, width, self.height)
        height = max(min(MIN_SIDE, self.height), self.height // 2)
        return Box(self.left, self.top + (self.height - height) // 2, self.width, height)


@dataclass(frozen=True, eq=False)
class Window:
    """A rectangle of a photo, with the Feature Gaussians that are rendered and compared with it."""

    photo: int  # number of the photo in the example
    box: Box  # the rectangle
    crop: Crop  # all Feature Gaussians that reach into the rectangle

    @property
    def camera(self) -> Cameras:
        """Camera whose picture is the window."""
        camera = box_camera(self.crop.example.photos, self.photo, self.box)
        return Cameras(camera["viewmat"][None], camera["K"][None], camera["width"], camera["height"])

    @property
    def image(self) -> Tensor:
        """The window's part of the photo, ``[h,w,3]`` sRGB in [0, 1]."""
        example = self.crop.example
        return torch.from_numpy(example.colors.change(self._part(example.images[self.photo]) / np.float32(255)))

    @property
    def mask(self) -> Tensor:
        """Mask ``[h,w]`` of the window's pixels that the example's views cover."""
        return torch.from_numpy(self._part(self.crop.example.mask(self.photo)))

    def _part(self, picture: np.ndarray) -> np.ndarray:
        """Return the box's part of a picture ``[h,w,...]``."""
        box = self.box
        return np.ascontiguousarray(picture[box.top : box.top + box.height, box.left : box.left + box.width])


def sample_window(
    example: Example, levels: tuple[int, ...], side: int, most: int, novel: float, rng: np.random.Generator
) -> Window:
    """Sample a window around a random pixel that the example's views cover.

    K is drawn from ``levels``. The window has ``side`` pixels per side, or less in smaller photos. The side is halved
    while more than ``most`` Feature Gaussians reach into the window. ``novel`` is the probability that novel views are
    tried first.
    """
    k = levels[int(rng.integers(len(levels)))]
    num_views = len(example.cameras)
    own_photos = rng.permutation(num_views)
    novel_photos = num_views + rng.permutation(len(example.photos) - num_views)
    order = np.concatenate([novel_photos, own_photos] if rng.random() < novel else [own_photos, novel_photos])
    # The first photo with pixels that the views cover is taken; if there is none, the last photo
    photo = int(order[0])
    pixels = np.zeros(0, np.int64)
    for photo in map(int, order):
        pixels = np.flatnonzero(example.mask(photo))
        if len(pixels):
            break
    pixel = int(pixels[rng.integers(len(pixels))]) if len(pixels) else 0
    photo_height, photo_width = example.images.shape[1:3]
    width = min(side, photo_width)
    height = min(side, photo_height)
    left = max(0, pixel % photo_width - width // 2)
    top = max(0, pixel // photo_width - height // 2)
    # The box is moved so that it lies inside the photo
    box = Box(min(left, photo_width - width), min(top, photo_height - height), width, height)
    rows = _reaching_rows(example, photo, box)
    while len(rows) > most and box.halved() != box:
        box = box.halved()
        rows = _reaching_rows(example, photo, box)
    return Window(photo, box, Crop(example, k, rows))


def _reaching_rows(example: Example, photo: int, box: Box) -> np.ndarray:
    """Return the rows of the Feature Gaussians that reach into a box of a photo, or may do so after corrections."""
    border = 4  # width, in pixels, of the frame around the box from which corrections may move Gaussians into it
    wide = Box(box.left - border, box.top - border, box.width + 2 * border, box.height + 2 * border)
    tiled = tile_view(
        make_splats(example.base, np.zeros(3)), **box_camera(example.photos, photo, wide), near=NEAR_PLANE
    )
    reached = np.zeros(len(example.base), bool)
    reached[tiled.ids[np.unique(tiled.flatten_ids)]] = True
    return np.flatnonzero(reached)


def box_camera(photos: Photos, photo: int, box: Box) -> dict[str, Any]:
    """Return the camera of a rectangle of a photo, as arguments of :func:`gsmerge.method.raster.tile_view`."""
    K = photos.Ks[photo].copy()
    K[:2, 2] -= box.left, box.top
    return {**photos.camera(photo), "K": K, "width": box.width, "height": box.height}
