"""Windows of photos, and the Feature Gaussians that reach into them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsmerge.canonical import NEAR
from gsmerge.metrics import WINDOW as LEAST
from gsmerge.training.examples import Example
from gsmerge.training.predict import Crop
from gsmerge.types import Cameras, Gaussians

SIGMAS = 3.0  # how far a footprint reaches, standard deviations
SPARE = 2.0  # pixels more, as corrections move Gaussians


@dataclass(frozen=True)
class Box:
    """A part of a photo: first column and row, width and height, pixels."""

    left: int
    top: int
    width: int
    height: int

    def halved(self) -> Box:
        """The middle half of the longer side; sides do not become shorter than the windows of SSIM."""
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
        photos = self.crop.example.photos
        K = torch.from_numpy(photos.Ks[self.photo].copy())
        K[:2, 2] -= torch.tensor([self.box.left, self.box.top], dtype=K.dtype)
        viewmat = torch.from_numpy(photos.viewmats[self.photo])
        return Cameras(viewmat[None], K[None], self.box.width, self.box.height)

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
    level, inside = example.levels[k], torch.zeros(len(example.centres), dtype=torch.bool)
    inside[rows] = True
    children = torch.nonzero(inside[level.parents])[:, 0]
    return Window(photo, box, Crop(example, k, rows, children, level.mask[children]))


def _about(x: int, y: int, side: int, width: int, height: int) -> Box:
    """The window about a pixel, moved into the photo."""
    w, h = min(side, width), min(side, height)
    return Box(min(max(0, x - w // 2), width - w), min(max(0, y - h // 2), height - h), w, h)


def _rows(example: Example, k: int, photo: int, box: Box) -> Tensor:
    """Rising rows of the merged Feature Gaussians of which a child reaches into the window."""
    level, photos = example.levels[k], example.photos
    reached = footprints_touch(level.children, photos.viewmats[photo], photos.Ks[photo], photos.eps2d, box)
    return torch.unique(level.parents[reached])


def footprints_touch(gaussians: Gaussians, viewmat: np.ndarray, K: np.ndarray, eps2d: float, box: Box) -> Tensor:
    """``[n]`` bool: Gaussians whose circle of three standard deviations reaches into a window."""
    pose, focal = torch.from_numpy(viewmat).float(), float(max(K[0, 0], K[1, 1]))
    camera = gaussians.means @ pose[:3, :3].T + pose[:3, 3]
    depths = camera[:, 2].clamp_min(NEAR)
    places = camera[:, :2] / depths[:, None] * torch.tensor([K[0, 0], K[1, 1]]).float()
    places = places + torch.tensor([K[0, 2] - box.left, K[1, 2] - box.top]).float()
    radii = SIGMAS * ((gaussians.scales.amax(1) * focal / depths).square() + eps2d).sqrt() + SPARE
    far = torch.maximum(-places, places - torch.tensor([box.width, box.height]).float()).amax(1)
    return (camera[:, 2] > NEAR) & (far < radii)
