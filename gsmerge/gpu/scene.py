"""The border between the core types and tensors on a device: one upload, one download."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from gsmerge.moments import Members
from gsmerge.render.photos import Photos, scene_photos
from gsmerge.types import Array, FeatureGaussians, Gaussians, Groups, PixelScene, UnalignedScene, as_array


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


@dataclass(frozen=True, eq=False)
class DeviceMembers:
    """The scene's Gaussians on a device, and ``footprints [n]``; see :class:`gsmerge.moments.Members`."""

    gaussians: Gaussians
    footprints: Tensor


@dataclass(frozen=True, eq=False)
class Features:
    """g Feature Gaussians on a device; fields and shapes as of :class:`gsmerge.types.FeatureGaussians`, no latents."""

    means: Tensor
    covars: Tensor
    weights: Tensor
    masses: Tensor
    extinctions: Tensor
    gains: Tensor
    spreads: Tensor
    sh0: Tensor
    shN: Tensor
    footprints: Tensor
    views: Tensor
    backing: Tensor
    starts: Tensor
    members: Tensor

    def __len__(self) -> int:
        return len(self.means)


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


def upload_pair(scene: PixelScene | UnalignedScene, device: torch.device) -> tuple[DevicePhotos, DevicePhotos]:
    """A scene's photos at full and at half size on a device."""
    return upload_photos(scene_photos(scene), device), upload_photos(scene_photos(scene, 2), device)


def upload_members(members: Members, device: torch.device) -> DeviceMembers:
    """The scene's Gaussians on a device."""
    return DeviceMembers(upload_gaussians(members, device), to_device(members.footprints, device))


def upload_gaussians(gaussians: Gaussians | Members, device: torch.device) -> Gaussians:
    """Gaussians on a device, in float32; :meth:`gsmerge.types.Gaussians.numpy` downloads them."""
    return Gaussians(*(to_device(getattr(gaussians, f.name), device, torch.float32) for f in fields(Gaussians)))


def download_features(features: Features) -> FeatureGaussians:
    """The core type of Feature Gaussians on a device, without latents."""
    columns = {f.name: as_array(getattr(features, f.name)) for f in fields(Features)}
    return FeatureGaussians(**columns, latents=np.zeros((len(features), 0), np.float32))


def download_groups(labels: Tensor, counts: tuple[int, ...]) -> Groups:
    """The core type of superpixels ``[v,h,w]`` on a device."""
    return Groups(as_array(labels.int()), counts)
