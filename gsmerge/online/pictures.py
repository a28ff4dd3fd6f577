"""The photos of a batch, and those that the state keeps of earlier ones, all at the state's size."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from gsmerge.online.state import Replay
from gsmerge.render.photos import Photos, photos_of
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras


@dataclass(frozen=True, eq=False)
class Shots:
    """Pictures ``images [v,h,w,3]`` float32, sRGB in [0, 1], and their cameras, of the same size."""

    images: np.ndarray
    cameras: Cameras

    def __len__(self) -> int:
        return len(self.images)

    def photos(self, level: int = 1) -> Photos:
        """As the stages want them that render against them, each side divided by ``level``."""
        return photos_of(self.images, self.cameras, level)


def shots_at(images: Tensor, cameras: Cameras, width: int, height: int) -> Shots:
    """Pictures of the cameras' size brought to another one (area averages)."""
    arrays, size = images.numpy(), (width, height)
    if size == (cameras.width, cameras.height):
        return Shots(arrays, cameras)
    small = parallel_map(lambda one: cv2.resize(one, size, interpolation=cv2.INTER_AREA), arrays)
    return Shots(np.stack(small), resized(cameras, width, height))


def resized(cameras: Cameras, width: int, height: int) -> Cameras:
    """The same views in pictures of another size."""
    shape = torch.tensor([[width / cameras.width], [height / cameras.height], [1.0]], dtype=torch.float64)
    return Cameras(cameras.viewmats.double(), cameras.Ks.double() * shape, width, height)


def joined_cameras(first: Cameras, second: Cameras) -> Cameras:
    """Cameras of one size, one after the other."""
    viewmats = torch.cat([first.viewmats.double(), second.viewmats.double()])
    return Cameras(viewmats, torch.cat([first.Ks.double(), second.Ks.double()]), first.width, first.height)


def view_places(known: Cameras, cameras: Cameras) -> np.ndarray:
    """``[v]`` which of all views each is: a known one of the same camera to the last bit, otherwise a further one."""
    places = {row: place for place, row in reversed(list(enumerate(_rows(known))))}
    found = [places.get(row, -1) for row in _rows(cameras)]
    numbers = np.array(found, np.int64)
    numbers[numbers < 0] = len(known) + np.arange(np.count_nonzero(numbers < 0))
    return numbers


def _rows(cameras: Cameras) -> list[bytes]:
    """Every camera as bytes."""
    flat = torch.cat([cameras.viewmats.double().flatten(1), cameras.Ks.double().flatten(1)], 1)
    return [row.tobytes() for row in flat.numpy()]


def kept_photos(replay: Replay, shots: Shots, places: np.ndarray, total: int, most: int) -> Replay:
    """The photos that are kept with new ones among them: every so many-th view of all, the step a power of two.

    Args:
        replay: Those kept so far.
        shots: The new ones.
        places: ``[s]`` which of all views each of them shows; of one that was kept already, the first stays.
        total: Views in all.
        most: Most photos that are kept.
    """
    numbers, rows = np.unique(places, return_index=True)
    fresh = ~np.isin(numbers, replay.views)
    views, step = np.concatenate([replay.views, numbers[fresh]]), 1
    while most and -(-total // step) > most:  # of all views, so that the batches' sizes do not matter
        step *= 2
    stays = (views % step == 0) & (most > 0)
    if most and not stays.any():  # earlier views came without photos
        stays[np.argmax(views)] = True
    old, new = stays[: len(replay)], stays[len(replay) :]
    images = np.rint(shots.images[rows[fresh][new]] * 255).astype(np.uint8)
    order = np.argsort(views[stays])
    return Replay(np.concatenate([replay.images[old], images])[order], views[stays][order])
