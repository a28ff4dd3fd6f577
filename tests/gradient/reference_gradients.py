"""Gradients by torch autograd through the slow float64 renderer, and scenes to compare them on."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from gsmerge import Cameras, Gaussians

sys.path.append(str(Path(__file__).resolve().parent.parent / "reference"))

from renderer import render_reference, view_colors

WIDTH, HEIGHT = 37, 21  # not multiples of a tile
NAMES = ("means", "quats", "scales", "opacities", "sh0", "shN", "viewmats")
BACKGROUND = (0.2, 0.5, 0.9)


def random_gaussians(n: int, degree: int = 0, seed: int = 0) -> Gaussians:
    """Around (0, 0, 3), of many sizes, quaternions of any length, some outside the image and behind the camera."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    means = normal(n, 3) * torch.tensor([0.9, 0.8, 0.7]) + torch.tensor([0.0, 0.0, 3.0])
    means[: n // 20, 2] -= 5
    return Gaussians(
        means,
        normal(n, 4) * 1.5,
        torch.exp(normal(n, 3) * 0.9 - 2.5),
        0.05 + 0.9 * torch.rand(n, generator=generator),
        normal(n, 1, 3),
        normal(n, (degree + 1) ** 2 - 1, 3) * 0.3,
    )


def turned_cameras(count: int = 2) -> Cameras:
    """Side by side, turned, with unequal focal lengths and the centre beside the middle."""
    viewmats = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    for view in range(count):
        angle = torch.tensor(0.2 - 0.3 * view, dtype=torch.float64)
        viewmats[view, 0, 0] = viewmats[view, 2, 2] = torch.cos(angle)
        viewmats[view, 0, 2], viewmats[view, 2, 0] = torch.sin(angle), -torch.sin(angle)
        viewmats[view, :3, 3] = torch.tensor([-0.4 + 0.5 * view, 0.1, 0.2 * view])
    K = torch.tensor([[33.0, 0, 17.3], [0, 31.0, 11.6], [0, 0, 1]], dtype=torch.float64)
    return Cameras(viewmats, K.repeat(count, 1, 1), WIDTH, HEIGHT)


def pixel_gradients(cameras: Cameras, seed: int = 0) -> tuple[Tensor, Tensor]:
    """What a loss might want of images ``[c,h,w,3]`` and alphas ``[c,h,w,1]``."""
    generator = torch.Generator().manual_seed(seed)
    shape = (len(cameras), cameras.height, cameras.width)
    return torch.randn(*shape, 3, generator=generator), torch.randn(*shape, 1, generator=generator)


def leaves(gaussians: Gaussians, cameras: Cameras, dtype: torch.dtype | None = None) -> list[Tensor]:
    """Tensors of the Gaussians and the view matrices that collect gradients."""
    tensors = [tensor.to(dtype or tensor.dtype) for tensor in vars(gaussians).values()]
    return [tensor.detach().clone().requires_grad_() for tensor in (*tensors, cameras.viewmats)]


def reference_gradients(
    gaussians: Gaussians,
    cameras: Cameras,
    background: Sequence[float] = BACKGROUND,
    seed: int = 0,
    *,
    antialiased: bool = False,
) -> list[Tensor]:
    """Gradients of the images and alphas times :func:`pixel_gradients`, in the order of NAMES, float64."""
    tensors = leaves(gaussians, cameras, torch.float64)
    means, quats, scales, opacities, sh0, shN, viewmats = tensors
    grad_images, grad_alphas = pixel_gradients(cameras, seed)
    for view in range(len(cameras)):
        drawn = render_reference(
            means, quats, scales, opacities, view_colors(means, torch.cat([sh0, shN], 1), viewmats[view]),
            viewmats[view], cameras.Ks[view], cameras.width, cameras.height,
            background=tuple(background), antialiased=antialiased,
        )  # fmt: skip
        loss = (drawn.image * grad_images[view]).sum() + ((1 - drawn.transmittance) * grad_alphas[view, ..., 0]).sum()
        loss.backward()
    return [torch.zeros_like(tensor) if tensor.grad is None else tensor.grad for tensor in tensors]


def assert_close(actual: Sequence[Tensor], expected: Sequence[Tensor], most: float = 1e-3) -> None:
    """Relative L2 error below ``most``, tensor by tensor."""
    for name, one, other in zip(NAMES, actual, expected, strict=False):
        assert torch.isfinite(one).all(), name
        error, size = float((one.double() - other).norm()), float(other.norm())
        assert error <= most * size + 1e-9, f"{name}: {error:.2g} of {size:.2g}"
