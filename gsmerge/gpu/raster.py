"""Drawing on a device: one function for an image, one for each of its transposes.

On CUDA gsplat draws, on the CPU the project's own kernels; all other files here work with either.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsmerge.gpu.scene import DevicePhotos
from gsmerge.render import contributions, plan_view
from gsmerge.render.colored import Shape, draw_colored, seen_colors
from gsmerge.render.photos import NEAR
from gsmerge.render.plan import Splats
from gsmerge.types import SH_C0, Gaussians


def draw(
    shape: Shape,
    colors: Tensor,
    photos: DevicePhotos,
    view: int,
    background: Tensor,
    *,
    near: float = NEAR,
    eps2d: float | None = None,
    antialiased: bool = False,
) -> tuple[Tensor, Tensor]:
    """Image ``[h,w,3]`` of one view and ``[n]`` bool, which Gaussians have a footprint in it.

    Args:
        shape: Means ``[n,3]``, quaternions ``[n,4]`` of length one, scales ``[n,3]`` and opacities ``[n]``, float32.
        colors: ``[n,3]``, any sign. The image is differentiable in them and in the shape.
        photos: Whose cameras.
        view: Of the photos.
        background: ``[3]``.
        near: Nearest depth drawn.
        eps2d: Low-pass, square pixels; None: that of the photos.
        antialiased: Lower the opacity by what the low-pass adds to the footprint.
    """
    eps2d = photos.host.eps2d if eps2d is None else eps2d
    if colors.device.type == "cpu":
        camera = photos.host.camera(view) | {"near": near, "eps2d": eps2d, "antialiased": antialiased}
        return draw_colored(shape, colors, camera, background.numpy())
    from gsmerge.render.cuda import rasterize

    drawn, reached = rasterize(
        shape, colors, _cameras(photos, view), background, eps2d=eps2d, antialiased=antialiased, near=near,
        unit_quats=True,
    )  # fmt: skip
    return drawn.images[0], reached[0]


def _cameras(photos: DevicePhotos, view: int) -> tuple[Tensor, Tensor, int, int]:
    return photos.viewmats[view : view + 1], photos.Ks[view : view + 1], photos.width, photos.height


def draw_all(gaussians: Gaussians, photos: DevicePhotos) -> list[Tensor]:
    """``[h,w,3]`` render of every photo over black, not clipped."""
    return [draw_gaussians(gaussians, photos, view) for view in range(len(photos))]


def draw_gaussians(gaussians: Gaussians, photos: DevicePhotos, view: int, *, near: float = NEAR) -> Tensor:
    """``[h,w,3]`` render of one photo over black, not clipped."""
    colors = shown_colors(gaussians, photos, view)
    return draw_black(shape_of(gaussians), colors, photos, view, near=near)


def draw_black(shape: Shape, colors: Tensor, photos: DevicePhotos, view: int, *, near: float = NEAR) -> Tensor:
    """:func:`draw` over black, the image alone."""
    return draw(shape, colors, photos, view, torch.zeros(3, device=colors.device), near=near)[0]


def shape_of(gaussians: Gaussians) -> Shape:
    """Means, quaternions, scales and opacities."""
    return gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities


def shown_colors(gaussians: Gaussians, photos: DevicePhotos, view: int) -> Tensor:
    """``[n,3]`` colours that Gaussians show a view, not below 0."""
    if gaussians.shN.shape[1] == 0:
        return (0.5 + SH_C0 * gaussians.sh0[:, 0]).clamp_min(0)
    return harmonic_colors(gaussians.means, gaussians.sh0, gaussians.shN, photos, view)


def harmonic_colors(means: Tensor, sh0: Tensor, shN: Tensor, photos: DevicePhotos, view: int) -> Tensor:
    """``[n,3]`` colours of harmonics ``[n,1,3]`` and ``[n,k-1,3]`` in a view, not below 0, without gradient."""
    if means.device.type == "cpu":
        return seen_colors(means, sh0, shN, photos.host.viewmats[view])
    from gsmerge.render.cuda import harmonic_colors as by_gsplat

    with torch.no_grad():
        return by_gsplat(means, torch.cat([sh0, shN], 1), photos.eyes[view])


def draw_and_transpose(shape: Shape, colors: Tensor, photos: DevicePhotos, view: int) -> tuple[Tensor, Transpose]:
    """The image of a view over black, and the function that takes images back to the Gaussians that show there."""
    with torch.enable_grad():
        leaf = colors.detach().requires_grad_()
        image, reached = draw(shape, leaf, photos, view, torch.zeros(3, device=colors.device))
    return image.detach(), Transpose(image, leaf, reached)


class Transpose:
    """Sums over the pixels of a view of every Gaussian's blending weight times an image.

    It is the transpose of drawing as a linear map from colours to images, which is the gradient in the colours.
    ``reached`` is ``[n]`` bool: which Gaussians have a footprint in the view.
    """

    def __init__(self, image: Tensor, colors: Tensor, reached: Tensor):
        self.image, self.colors, self.reached = image, colors, reached

    def __call__(self, values: Tensor) -> Tensor:
        """``[n,3]`` of an image ``[h,w,3]``."""
        return torch.autograd.grad(self.image, self.colors, values.contiguous(), retain_graph=True)[0]


def peak_weights(gaussians: Gaussians, photos: DevicePhotos, view: int) -> tuple[Tensor, Tensor]:
    """``[n]`` largest blending weight of every Gaussian at some pixel of a view; ``[n]`` bool: it lies in the view."""
    if gaussians.means.device.type != "cpu":
        from gsmerge.render.cuda import peak_weights as gsplat_peaks

        return gsplat_peaks(shape_of(gaussians), _cameras(photos, view), eps2d=photos.host.eps2d)
    means, quats, scales, opacities = (tensor.contiguous().numpy() for tensor in shape_of(gaussians))
    sh0, shN = gaussians.sh0.numpy(), gaussians.shN.numpy()
    plan = plan_view(Splats(means, quats, scales, opacities, sh0, shN, np.zeros(3)), **photos.host.camera(view))
    inside = torch.zeros(len(gaussians), dtype=torch.bool)
    inside[torch.from_numpy(plan.ids).long()] = True
    return torch.from_numpy(contributions(plan)[1]), inside
