"""The border between the core types and tensors on a device: one upload, one download."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from gsmerge.moments import Members
from gsmerge.render.photos import Photos, scene_photos
from gsmerge.types import Array, FeatureGaussians, Gaussians, Groups, PixelScene, UnalignedScene


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
class Shapes:
    """n Gaussians on a device, float32; fields and shapes as of :class:`gsmerge.types.Gaussians`."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh0: Tensor
    shN: Tensor

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, index: Tensor) -> Shapes:
        """The rows that a mask or an integer tensor selects."""
        return type(self)(*(getattr(self, f.name)[index] for f in fields(self)))


@dataclass(frozen=True, eq=False)
class DeviceMembers(Shapes):
    """The scene's Gaussians on a device, float32; shapes as of :class:`gsmerge.moments.Members`."""

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


def to_core(tensor: Tensor) -> np.ndarray:
    """A tensor as the core types hold it: the only place of this package that makes their arrays."""
    array: np.ndarray = tensor.cpu().numpy()
    return array


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
    return DeviceMembers(*(to_device(getattr(members, f.name), device) for f in fields(DeviceMembers)))


def upload_gaussians(gaussians: Gaussians, device: torch.device) -> Shapes:
    """Gaussians on a device, in float32."""
    return Shapes(*(to_device(getattr(gaussians, f.name), device, torch.float32) for f in fields(Shapes)))


def download_gaussians(shapes: Shapes) -> Gaussians:
    """The core type of Gaussians on a device."""
    return Gaussians(*(to_core(getattr(shapes, f.name).float()) for f in fields(Shapes)))


def download_features(features: Features) -> FeatureGaussians:
    """The core type of Feature Gaussians on a device, without latents."""
    columns = {f.name: to_core(getattr(features, f.name)) for f in fields(Features)}
    return FeatureGaussians(**columns, latents=np.zeros((len(features), 0), np.float32))


def download_groups(labels: Tensor, counts: tuple[int, ...]) -> Groups:
    """The core type of superpixels ``[v,h,w]`` on a device."""
    return Groups(to_core(labels.int()), counts)
