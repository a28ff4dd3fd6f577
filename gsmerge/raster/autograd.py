"""Differentiable rendering of tensors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsmerge.geometry import camera_centres
from gsmerge.kernels.raster import sh
from gsmerge.kernels.raster.project import add_rows
from gsmerge.raster.composite import Rendering, composite, draw_views, prepare_views, view_colors
from gsmerge.raster.gradient import ColorGradients, color_gradients, gradients_of, plan_gradients, pose_gradient
from gsmerge.raster.view_plan import Array, Splats, ViewPlan, plan_view
from gsmerge.types import Cameras, Gaussians

Shape = tuple[Tensor, Tensor, Tensor, Tensor]  # means, quaternions, scales, opacities


class _Render(torch.autograd.Function):
    """Images and alphas (and depths, without gradient) from the tensors of Gaussians and view matrices."""

    @staticmethod
    def forward(
        ctx: Any, cameras: Cameras, background: Array, options: dict[str, Any], with_depths: bool, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        cameras = replace(cameras, viewmats=tensors[-1])
        splats, viewmats, Ks = prepare_views(Gaussians(*tensors[:-1]), cameras)
        plans: dict[int, ViewPlan] = {}

        def plan_one(view: int) -> ViewPlan:
            plans[view] = plan_view(splats, viewmats[view], Ks[view], cameras.width, cameras.height, **options)
            return plans[view]

        drawn = draw_views(plan_one, (len(cameras), cameras.height, cameras.width), background, with_depths)
        ctx.plans = plans
        images, alphas = torch.from_numpy(drawn.images), torch.from_numpy(drawn.alphas)
        # kept through autograd, so that it notices when one of them was overwritten in the meantime
        ctx.save_for_backward(*tensors, images, alphas)
        if drawn.depths is None:
            return images, alphas
        depths = torch.from_numpy(drawn.depths)
        ctx.mark_non_differentiable(depths)
        return images, alphas, depths

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_images: Tensor, grad_alphas: Tensor, *_: Tensor) -> tuple[Any, ...]:
        *tensors, images, alphas = ctx.saved_tensors
        lefts = 1 - alphas[..., 0]
        totals = [np.zeros(tensor.shape, np.float32) for tensor in tensors[:-1]]
        poses = np.zeros(tensors[-1].shape)
        shade: ColorGradients | None = None
        for view, plan in sorted(ctx.plans.items()):
            image, left, grad_image, grad_alpha = (
                np.ascontiguousarray(tensor.numpy())
                for tensor in (images[view], lefts[view], grad_images[view], grad_alphas[view, ..., 0])
            )
            colors, moves = view_colors(plan), ctx.needs_input_grad[-1]
            shape = gradients_of(plan, colors, image, left, grad_image, -grad_alpha, moves)
            shade = color_gradients(plan, shape.colors, colors, used=shade)
            rows = [shape.means + shade.means, shape.quats, shape.scales, shape.opacities, shade.sh0, shade.shN]
            for total, row in zip(totals, rows, strict=True):
                add_rows(plan.ids, row.reshape(len(row), total[:1].size), total.reshape(len(total), total[:1].size))
            if moves:
                poses[view] = pose_gradient(plan, shape, shade)
        gradients = [
            torch.from_numpy(total).to(tensor.device, tensor.dtype) if needed else None
            for total, tensor, needed in zip([*totals, poses], tensors, ctx.needs_input_grad[4:], strict=True)
        ]
        return None, None, None, None, *gradients


def render_tensors(
    gaussians: Gaussians, cameras: Cameras, background: Array, *, with_depths: bool, **options: Any
) -> Rendering:
    """Render tensors on the CPU with a backward pass; see :func:`gsmerge.render`."""
    tensors = (*vars(gaussians).values(), cameras.viewmats)
    cameras = replace(cameras, viewmats=cameras.viewmats.detach())
    drawn = _Render.apply(cameras, background, options, with_depths, *tensors)
    return Rendering(drawn[0], drawn[1], drawn[2] if with_depths else None)


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
        return None, None, *(spread(values) for values in rows)


def draw_colored(shape: Shape, colors: Tensor, camera: dict[str, Any], background: np.ndarray) -> tuple[Tensor, Tensor]:
    """Draw one view from colours, differentiable, on the CPU; on a GPU: :func:`gsmerge.raster.cuda.rasterize`.

    ``shape`` are means ``[n,3]``, quaternions ``[n,4]``, scales ``[n,3]`` and opacities ``[n]``,
    ``colors [n,3]`` of any sign, all float32. Returns the image ``[h,w,3]``, differentiable in all
    of them, and a mask ``[n]`` of the Gaussians with a footprint in the view.
    """
    return _Draw.apply(camera, background, *shape, colors)


def seen_colors(means: Tensor, sh0: Tensor, shN: Tensor, viewmat: np.ndarray) -> Tensor:
    """Evaluate the colours ``[n,3]`` of spherical harmonics in a view, clipped at 0, without gradient."""
    eye = camera_centres(viewmat).astype(np.float32)
    count, arrays = len(means), [tensor.detach().contiguous().numpy() for tensor in (means, sh0, shN)]
    colors = np.empty((count, 3), np.float32)
    sh.view_colors(*arrays, np.arange(count, dtype=np.int32), eye, 0, count, colors)
    return torch.from_numpy(colors)
