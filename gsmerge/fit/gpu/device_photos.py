"""Gaussians and photos on a device, drawing into the photos' cameras, and its transpose.

On CUDA gsplat draws, on the CPU the project's own kernels; all other files here work with either.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from gsmerge.raster import contributions, plan_view
from gsmerge.raster.autograd import Shape, draw_colored, seen_colors
from gsmerge.raster.photos import Photos
from gsmerge.raster.view_plan import Splats
from gsmerge.types import SH_C0, Array, Gaussians


@dataclass(frozen=True, eq=False)
class DevicePhotos:
    """V photos of one size on a device; see :class:`gsmerge.raster.photos.Photos`."""

    images: Tensor  # [v,h,w,3] float32
    viewmats: Tensor  # [v,4,4] float32 world to camera
    Ks: Tensor  # [v,3,3] float32
    eyes: Tensor  # [v,3] float32 centres of the cameras
    host: Photos  # The same photos in the computer's memory, whose cameras the kernels read

    def __len__(self) -> int:
        return len(self.images)

    @property
    def height(self) -> int:
        """Number of rows."""
        return self.images.shape[1]

    @property
    def width(self) -> int:
        """Number of columns."""
        return self.images.shape[2]

    def camera(self, view: int) -> tuple[Tensor, Tensor, int, int]:
        """Return a view's viewmat, intrinsics, width and height, for :func:`gsmerge.raster.cuda.rasterize`."""
        return self.viewmats[view], self.Ks[view], self.width, self.height


def to_device(array: Array, device: torch.device, dtype: torch.dtype | None = None) -> Tensor:
    """Copy an array or a tensor to a device."""
    if isinstance(array, np.ndarray) and not array.flags.writeable:  # torch warns of those, though none is written to
        array = array.copy()
    return torch.as_tensor(array).to(device, dtype)


def upload_photos(photos: Photos, device: torch.device) -> DevicePhotos:
    """Copy photos and their cameras to a device."""
    rotations, shifts = photos.viewmats[:, :3, :3], photos.viewmats[:, :3, 3]
    eyes = -np.einsum("vji,vj->vi", rotations, shifts)
    arrays = np.ascontiguousarray(photos.images), photos.viewmats, photos.Ks, eyes
    images, viewmats, Ks, centres = (to_device(array, device, torch.float32) for array in arrays)
    return DevicePhotos(images, viewmats, Ks, centres, photos)


def upload_gaussians(
    gaussians: Gaussians, device: torch.device, dtype: torch.dtype | None = torch.float32
) -> Gaussians:
    """Copy Gaussians to a device; with ``dtype`` None each array keeps its dtype."""
    arrays = (getattr(gaussians, f.name) for f in fields(Gaussians))
    return Gaussians(*(to_device(array, device, dtype) for array in arrays))


def draw_view(
    shape: Shape,
    colors: Tensor,
    photos: DevicePhotos,
    view: int,
    background: Tensor,
    *,
    eps2d: float | None = None,
    antialiased: bool = False,
) -> tuple[Tensor, Tensor]:
    """Draw Gaussians into one view; return the image ``[h,w,3]`` and a mask ``[n]`` of Gaussians drawn there.

    ``shape`` are means, quaternions, scales and opacities, float32; ``colors [n,3]`` may have any
    sign, ``background`` is ``[3]``. The image is differentiable in shape and colours. ``eps2d`` is
    the low-pass in square pixels, None: that of the photos.
    """
    eps2d = photos.host.eps2d if eps2d is None else eps2d
    if colors.device.type == "cpu":
        camera = photos.host.camera(view) | {"eps2d": eps2d, "antialiased": antialiased}
        return draw_colored(shape, colors, camera, background.numpy())
    from gsmerge.raster.cuda import rasterize

    image, _, _, reached = rasterize(
        shape, colors, photos.camera(view), background, eps2d=eps2d, antialiased=antialiased
    )
    return image, reached


def draw_black(shape: Shape, colors: Tensor, photos: DevicePhotos, view: int) -> Tensor:
    """Draw one view ``[h,w,3]`` over black."""
    return draw_view(shape, colors, photos, view, torch.zeros(3, device=colors.device))[0]


def draw_gaussians(gaussians: Gaussians, photos: DevicePhotos, view: int) -> Tensor:
    """Render one photo ``[h,w,3]`` over black, not clipped."""
    if gaussians.shN.shape[1] == 0:
        colors = (0.5 + SH_C0 * gaussians.sh0[:, 0]).clamp_min(0)
    else:
        colors = harmonic_colors(gaussians.means, gaussians.sh0, gaussians.shN, photos, view)
    return draw_black(shape_of(gaussians), colors, photos, view)


def shape_of(gaussians: Gaussians) -> Shape:
    """Return means, quaternions, scales and opacities."""
    return gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities


def harmonic_colors(means: Tensor, sh0: Tensor, shN: Tensor, photos: DevicePhotos, view: int) -> Tensor:
    """Evaluate the colours ``[n,3]`` of spherical harmonics in a view, clipped at 0, without gradient."""
    if means.device.type == "cpu":
        return seen_colors(means, sh0, shN, photos.host.viewmats[view])
    from gsmerge.raster import cuda

    with torch.no_grad():
        return cuda.harmonic_colors(means, torch.cat([sh0, shN], 1), photos.eyes[view])


def draw_and_transpose(
    shape: Shape, colors: Tensor, photos: DevicePhotos, view: int
) -> tuple[Tensor, Callable[[Tensor], Tensor], Tensor]:
    """Draw a view over black; return the image, a function for its transpose, and a mask ``[n]`` of Gaussians drawn.

    The transpose takes an image ``[h,w,3]`` to sums ``[n,3]`` of each Gaussian's blending weight times the image.
    """
    with torch.enable_grad():
        leaf = colors.detach().requires_grad_()
        image, reached = draw_view(shape, leaf, photos, view, torch.zeros(3, device=colors.device))

    def transpose(values: Tensor) -> Tensor:
        return torch.autograd.grad(image, leaf, values.contiguous(), retain_graph=True)[0]

    return image.detach(), transpose, reached


def view_peaks(shape: Shape, photos: DevicePhotos, view: int) -> Tensor:
    """Find the largest blending weight ``[n]`` of every Gaussian in a view."""
    if shape[0].device.type != "cpu":
        from gsmerge.raster import cuda

        return cuda.peak_weights(shape, photos.camera(view), eps2d=photos.host.eps2d)[0]
    means, quats, scales, opacities = (tensor.contiguous().numpy() for tensor in shape)
    sh0, shN = (np.zeros((len(means), size, 3), np.float32) for size in (1, 0))
    plan = plan_view(Splats(means, quats, scales, opacities, sh0, shN, np.zeros(3)), **photos.host.camera(view))
    return torch.from_numpy(contributions(plan)[1])
