"""Windows of photos, and the Feature Gaussians that reach into them."""

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

LEAST = 16  # pixels per side below which windows are not halved
SPARE = 4  # pixels about a window in which Gaussians may lie that corrections move into it


@dataclass(frozen=True)
class Box:
    """A part of a photo: first column and row, width and height, pixels."""

    left: int
    top: int
    width: int
    height: int

    def halved(self) -> Box:
        """The middle half of the longer side; sides do not become too short to see anything."""
        if self.width >= self.height:
            width = max(min(LEAST, self.width), self.width // 2)
            return Box(self.left + (self.width - width) // 2, self.top, width, self.height)
        height = max(min(LEAST, self.height), self.height // 2)
        return Box(self.left, self.top + (self.height - height) // 2, self.width, height)


@dataclass(frozen=True, eq=False)
class Window:
    """A part of a photo, and what is rendered to be compared with it.

    Args:
        photo: Which of the example's photos.
        box: Which part of it.
        crop: All Feature Gaussians whose children reach into it.
    """

    photo: int
    box: Box
    crop: Crop

    @property
    def camera(self) -> Cameras:
        """One camera that sees the box alone."""
        c = box_camera(self.crop.example.photos, self.photo, self.box)
        viewmat, K = torch.from_numpy(c["viewmat"]), torch.from_numpy(c["K"])
        return Cameras(viewmat[None], K[None], c["width"], c["height"])

    def part(self, images: np.ndarray) -> Tensor:
        """The box of one of ``images [p,h,w,...]``."""
        b = self.box
        part = images[self.photo, b.top : b.top + b.height, b.left : b.left + b.width]
        return torch.from_numpy(np.ascontiguousarray(part))


def random_window(example: Example, side: int, most: int, novel: float, rng: np.random.Generator) -> Window:
    """A window about a random pixel that the scene has something to show for.

    Args:
        example: The scene.
        side: Of the window, pixels; shorter where the photo is.
        most: Most Feature Gaussians that may reach into it; one with more is halved.
        novel: Share of the windows that are in novel views, where there are any.
        rng: Chooses K, photo and pixel.
    """
    k = list(example.levels)[int(rng.integers(len(example.levels)))]
    found = [example.photo_ids(novel=kind) for kind in (False, True)]
    wanted = rng.random() < novel
    ids = (found[wanted] or found[not wanted]) or [0]
    photo = ids[int(rng.integers(len(ids)))]
    pixels = np.flatnonzero(example.masks[photo])
    pixel = int(pixels[rng.integers(len(pixels))]) if len(pixels) else 0
    height, width = example.masks.shape[1:]
    box = _about(pixel % width, pixel // width, side, width, height)
    rows = _rows(example, k, photo, box)
    while len(rows) > most and box.halved() != box:
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


def _about(x: int, y: int, side: int, width: int, height: int) -> Box:
    """The window about a pixel, moved into the photo."""
    w, h = min(side, width), min(side, height)
    return Box(min(max(0, x - w // 2), width - w), min(max(0, y - h // 2), height - h), w, h)


def _rows(example: Example, k: int, photo: int, box: Box) -> Tensor:
    """Rising rows of the merged Feature Gaussians of which a child reaches into the window, or nearly does."""
    level = example.levels[k]
    wide = Box(box.left - SPARE, box.top - SPARE, box.width + 2 * SPARE, box.height + 2 * SPARE)
    plan = plan_view(prepare(level.children, np.zeros(3)), **box_camera(example.photos, photo, wide), near=NEAR)
    reached = torch.from_numpy(plan.ids[np.unique(plan.members)].astype(np.int64))
    return torch.unique(level.parents[reached])


def box_camera(photos: Photos, photo: int, box: Box) -> dict[str, Any]:
    """The camera that sees a part of a photo alone, as :func:`gsmerge.render.plan_view` takes it."""
    K = photos.Ks[photo].copy()
    K[:2, 2] -= box.left, box.top
    return {**photos.camera(photo), "K": K, "width": box.width, "height": box.height}
