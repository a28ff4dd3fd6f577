"""Bring Gaussians and photos to a device."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from gsmerge.render.photos import Photos
from gsmerge.types import Array, Gaussians


@dataclass(frozen=True, eq=False)
class DevicePhotos:
    """V photos of one size on a device; see :class:`gsmerge.render.photos.Photos`.

    Args:
        images: ``[v,h,w,3]`` float32.
        viewmats: ``[v,4,4]`` float32 world to camera.
        Ks: ``[v,3,3]`` float32.
        eyes: ``[v,3]`` float32 centres of the cameras.
        host: The same photos in the computer's memory, whose cameras the kernels read.
    """

    images: Tensor
    viewmats: Tensor
    Ks: Tensor
    eyes: Tensor
    host: Photos

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


def to_device(array: Array, device: torch.device, dtype: torch.dtype | None = None) -> Tensor:
    """An array of a core type, or a tensor, on a device."""
    if isinstance(array, np.ndarray) and not array.flags.writeable:  # torch warns of those, though none is written to
        array = array.copy()
    return torch.as_tensor(array).to(device, dtype)


def upload_photos(photos: Photos, device: torch.device) -> DevicePhotos:
    """Photos and their cameras on a device."""
    rotations, shifts = photos.viewmats[:, :3, :3], photos.viewmats[:, :3, 3]
    eyes = -np.einsum("vji,vj->vi", rotations, shifts)
    arrays = np.ascontiguousarray(photos.images), photos.viewmats, photos.Ks, eyes
    images, viewmats, Ks, centres = (to_device(array, device, torch.float32) for array in arrays)
    return DevicePhotos(images, viewmats, Ks, centres, photos)


def upload_gaussians(gaussians: Gaussians, device: torch.device) -> Gaussians:
    """Gaussians on a device, in float32; :meth:`gsmerge.types.Gaussians.numpy` downloads them."""
    return Gaussians(*(to_device(getattr(gaussians, f.name), device, torch.float32) for f in fields(Gaussians)))
