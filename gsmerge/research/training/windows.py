"""Windows of photos, with the Feature Gaussians that reach into them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsmerge.render import plan_view, prepare
from gsmerge.render.photos import NEAR, Photos
from gsmerge.research.training.examples import Example
from gsmerge.research.training.predict import Crop
from gsmerge.types import Cameras

MIN_SIDE = 16  # pixels; sides are not halved to less
BORDER = 4  # pixels around a window, from which corrections may move Gaussians into it


@dataclass(frozen=True)
class Box:
    """A part of a photo: first column and row, width and height, pixels."""

    left: int
    top: int
    width: int
    height: int

    def halved(self) -> Box:
        """The middle half of the longer side, at least ``MIN_SIDE`` pixels."""
        if self.width >= self.height:
            width = max(min(MIN_SIDE, self.width), self.width // 2)
            return Box(self.left + (self.width - width) // 2, self.top, width, self.height)
        height = max(min(MIN_SIDE, self.height), self.height // 2)
        return Box(self.left, self.top + (self.height - height) // 2, self.width, height)


@dataclass(frozen=True, eq=False)
class Window:
    """A part of a photo, and the Feature Gaussians whose render is compared with it."""

    photo: int  # which of the example's photos
    box: Box  # which part of it
    crop: Crop  # all Feature Gaussians whose children reach into it

    @property
    def camera(self) -> Cameras:
        """One camera whose image is the box."""
        c = box_camera(self.crop.example.photos, self.photo, self.box)
        viewmat, K = torch.from_numpy(c["viewmat"]), torch.from_numpy(c["K"])
        return Cameras(viewmat[None], K[None], c["width"], c["height"])

    def part(self, images: np.ndarray) -> Tensor:
        """The box of one of ``images [p,h,w,...]``."""
        b = self.box
        part = images[self.photo, b.top : b.top + b.height, b.left : b.left + b.width]
        return torch.from_numpy(np.ascontiguousarray(part))


def sample_window(example: Example, side: int, max_features: int, novel: float, rng: np.random.Generator) -> Window:
    """A window around a random pixel of the mask.

    Args:
        example: The scene.
        side: Of the window, pixels; shorter where the photo is.
        max_features: Feature Gaussians that may reach into it; a window with more is halved.
        novel: Share of the windows in novel views, if there are any.
        rng: Chooses K, photo and pixel.
    """
    k = list(example.levels)[int(rng.integers(len(example.levels)))]
    ids_by_kind = [example.photo_ids(novel=kind) for kind in (False, True)]
    kind = rng.random() < novel
    ids = ids_by_kind[kind] or ids_by_kind[not kind] or [0]
    photo = ids[int(rng.integers(len(ids)))]
    pixels = np.flatnonzero(example.masks[photo])
    pixel = int(pixels[rng.integers(len(pixels))]) if len(pixels) else 0
    height, width = example.masks.shape[1:]
    box = _box_around(pixel % width, pixel // width, side, width, height)
    rows = _rows(example, k, photo, box)
    while len(rows) > max_features and box.halved() != box:
        box = box.halved()
        rows = _rows(example, k, photo, box)
    return _window(example, k, photo, box, rows)


def whole_photo(example: Example, photo: int) -> Window:
    """A whole photo, at the smallest K."""
    k, (height, width) = min(example.levels), example.masks.shape[1:]
    box = Box(0, 0, width, height)
    return _window(example, k, photo, box, _rows(example, k, photo, box))


def _window(example: Example, k: int, photo: int, box: Box, rows: Tensor) -> Window:
    """With all children of the Feature Gaussians ``rows``."""
    level, inside = example.levels[k], torch.zeros(len(example.centres), dtype=torch.bool)
    inside[rows] = True
    children = torch.nonzero(inside[level.parents])[:, 0]
    return Window(photo, box, Crop(example, k, rows, children, level.mask[children]))


def _box_around(x: int, y: int, side: int, width: int, height: int) -> Box:
    """The window around a pixel, moved into the photo."""
    w, h = min(side, width), min(side, height)
    return Box(min(max(0, x - w // 2), width - w), min(max(0, y - h // 2), height - h), w, h)


def _rows(example: Example, k: int, photo: int, box: Box) -> Tensor:
    """Ascending rows of the merged Feature Gaussians with a child that reaches into the window, or nearly does."""
    level = example.levels[k]
    wide = Box(box.left - BORDER, box.top - BORDER, box.width + 2 * BORDER, box.height + 2 * BORDER)
    plan = plan_view(prepare(level.children, np.zeros(3)), **box_camera(example.photos, photo, wide), near=NEAR)
    reached = torch.from_numpy(plan.ids[np.unique(plan.members)].astype(np.int64))
    return torch.unique(level.parents[reached])


def box_camera(photos: Photos, photo: int, box: Box) -> dict[str, Any]:
    """The camera whose image is a part of a photo, as arguments of :func:`gsmerge.render.plan_view`."""
    K = photos.Ks[photo].copy()
    K[:2, 2] -= box.left, box.top
    return {**photos.camera(photo), "K": K, "width": box.width, "height": box.height}
