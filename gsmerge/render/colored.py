"""One view of Gaussians with colours of their own, as tensors on the CPU, differentiable.

What a training loop in torch needs: :func:`gsmerge.render` takes colours from spherical harmonics and cuts them at 0,
these colours are taken as they are.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsmerge.kernels.raster import harmonics
from gsmerge.render.blend import composite
from gsmerge.render.gradient import plan_gradients
from gsmerge.render.plan import Splats, plan_view

Shape = tuple[Tensor, Tensor, Tensor, Tensor]  # means, quaternions, scales, opacities


class _Draw(torch.autograd.Function):
    """Image of tensors on the CPU, by the kernels."""

    @staticmethod
    def forward(ctx: Any, camera: dict[str, Any], background: np.ndarray, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        means, quats, scales, opacities, colors = (tensor.detach().contiguous().numpy() for tensor in tensors)
        unused = np.zeros((len(colors), 0, 3), np.float32)
        splats = Splats(means, quats, scales, opacities, sh0=unused, shN=unused, origin=np.zeros(3))
        plan = plan_view(splats, **camera)
        image, transmittance = composite(plan, colors, background)
        ctx.plan, ctx.drawn = plan, {"image": image, "transmittance": transmittance, "colors": colors}
        reached = torch.zeros(len(means), dtype=torch.bool)
        reached[torch.from_numpy(plan.ids).long()] = True
        ctx.mark_non_differentiable(reached)
        return torch.from_numpy(image), reached

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor, _: Any) -> tuple[Any, ...]:
        gradients = plan_gradients(ctx.plan, grad_image.numpy(), **ctx.drawn)

        def spread(rows: np.ndarray) -> Tensor:
            every = np.zeros((len(ctx.plan.splats), *rows.shape[1:]), np.float32)
            every[gradients.ids] = rows
            return torch.from_numpy(every)

        g = gradients
        rows = g.means, g.quats, g.scales, g.opacities, g.colors
        return None, None, *(spread(one) for one in rows)


def draw_colored(shape: Shape, colors: Tensor, camera: dict[str, Any], background: np.ndarray) -> tuple[Tensor, Tensor]:
    """Image of one view, by the kernels; on a GPU there is :func:`gsmerge.render.cuda.rasterize`.

    Args:
        shape: Means ``[n,3]``, quaternions ``[n,4]``, scales ``[n,3]`` and opacities ``[n]``, float32.
        colors: ``[n,3]``, any sign, float32.
        camera: As :meth:`gsmerge.render.photos.Photos.camera` gives it.

    Returns:
        ``[h,w,3]``, differentiable in all tensors, and ``[n]`` bool: which Gaussians have a footprint in the view.
    """
    return _Draw.apply(camera, background, *shape, colors)


def seen_colors(means: Tensor, sh0: Tensor, shN: Tensor, viewmat: np.ndarray) -> Tensor:
    """``[n,3]`` colours that harmonics ``[n,1,3]`` and ``[n,k-1,3]`` show a view, not below 0, without gradient."""
    eye = (-viewmat[:3, :3].T @ viewmat[:3, 3]).astype(np.float32)
    count, arrays = len(means), [tensor.detach().contiguous().numpy() for tensor in (means, sh0, shN)]
    colors = np.empty((count, 3), np.float32)
    harmonics.view_colors(*arrays, np.arange(count, dtype=np.int32), eye, 0, count, colors)
    return torch.from_numpy(colors)
