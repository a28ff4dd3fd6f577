"""Render tensors so that images have gradients."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsmerge.method.kernels.raster.project import add_rows
from gsmerge.method.raster.composite import Rendering, draw_views, prepare_views, view_colors
from gsmerge.method.raster.gradient import ColorGradients, color_gradients, gradients_of, pose_gradient
from gsmerge.method.raster.tiled_view import Array, TiledView, tile_view
from gsmerge.types import Cameras, Gaussians


class _Render(torch.autograd.Function):
    """Render images, alphas and, if requested, depths from tensors of Gaussians and view matrices.

    Depths have no gradient.
    """

    @staticmethod
    def forward(
        ctx: Any, cameras: Cameras, background: Array, options: dict[str, Any], with_depths: bool, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        """Draw all views. ``tensors`` are the fields of the Gaussians, and the view matrices."""
        cameras = replace(cameras, viewmats=tensors[-1])
        splats, viewmats, Ks = prepare_views(Gaussians(*tensors[:-1]), cameras)
        tiled_views: dict[int, TiledView] = {}

        def tile_one(view: int) -> TiledView:
            """Tile a view, and keep the result for the backward pass."""
            tiled_views[view] = tile_view(splats, viewmats[view], Ks[view], cameras.width, cameras.height, **options)
            return tiled_views[view]

        drawn = draw_views(tile_one, (len(cameras), cameras.height, cameras.width), background, with_depths)
        ctx.views = tiled_views
        images = torch.from_numpy(drawn.images)
        alphas = torch.from_numpy(drawn.alphas)
        # Save tensors through autograd, which notices if one of them is overwritten before the backward pass
        ctx.save_for_backward(*tensors, images, alphas)
        if drawn.depths is None:
            return images, alphas
        depths = torch.from_numpy(drawn.depths)
        ctx.mark_non_differentiable(depths)
        return images, alphas, depths

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_images: Tensor, grad_alphas: Tensor, *_: Tensor) -> tuple[Any, ...]:
        """Return the gradients of the arguments of :meth:`forward`, summed over the views, and None for the others."""
        *tensors, images, alphas = ctx.saved_tensors
        transmittances = 1 - alphas[..., 0]
        totals = [np.zeros(tensor.shape, np.float32) for tensor in tensors[:-1]]
        viewmat_grads = np.zeros(tensors[-1].shape)
        with_viewmat = ctx.needs_input_grad[-1]
        color_grads: ColorGradients | None = None
        for view, tiled in sorted(ctx.views.items()):
            image, transmittance, grad_image, grad_alpha = (
                np.ascontiguousarray(tensor.numpy())
                for tensor in (images[view], transmittances[view], grad_images[view], grad_alphas[view, ..., 0])
            )
            colors = view_colors(tiled)
            grads = gradients_of(
                tiled, colors, image=image, transmittance=transmittance, grad_image=grad_image, grad_left=-grad_alpha,
                with_viewmat=with_viewmat,
            )  # fmt: skip
            color_grads = color_gradients(tiled, grads.colors, colors, used=color_grads)
            columns = [
                grads.means + color_grads.means,
                grads.quats,
                grads.scales,
                grads.opacities,
                color_grads.sh0,
                color_grads.shN,
            ]
            for total, column in zip(totals, columns, strict=True):
                width = total[:1].size
                add_rows(grads.ids, column.reshape(len(column), width), total.reshape(len(total), width))
            if with_viewmat:
                viewmat_grads[view] = pose_gradient(tiled, grads, color_grads)
        gradients = [
            torch.from_numpy(total).to(tensor.dtype) if needed else None
            for total, tensor, needed in zip([*totals, viewmat_grads], tensors, ctx.needs_input_grad[4:], strict=True)
        ]
        return None, None, None, None, *gradients


def render_tensors(
    gaussians: Gaussians, cameras: Cameras, background: Array, *, with_depths: bool, **options: Any
) -> Rendering:
    """Render tensors on the CPU so that images and alphas are differentiable, see :func:`gsmerge.render`."""
    tensors = (*vars(gaussians).values(), cameras.viewmats)
    cameras = replace(cameras, viewmats=cameras.viewmats.detach())
    drawn = _Render.apply(cameras, background, options, with_depths, *tensors)
    return Rendering(drawn[0], drawn[1], drawn[2] if with_depths else None)
