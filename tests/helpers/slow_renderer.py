"""A slow renderer checks the fast one: in float64, one Gaussian after the other, over all pixels.

Written from the published formulas: EWA splatting (Zwicker et al. 2001), 3DGS (Kerbl et al. 2023) and gsplat's
conventions. It knows no tiles, boxes or early exits, and torch can differentiate it: the second half makes gradients
with it, and scenes to compare them on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from gsmerge import Cameras, Gaussians
from gsmerge.arrays import Array

torch = pytest.importorskip("torch", reason="torch is not installed")
Tensor = torch.Tensor


@dataclass(frozen=True)
class Reference:
    """Image ``[h,w,3]``, transmittance ``[h,w]``, depth ``[h,w]`` and weights ``[n,h,w]``, float64."""

    image: Array
    transmittance: Array
    depth: Array
    weights: Array


def harmonics(directions: Tensor) -> Tensor:
    """Return ``[n,25]`` real spherical harmonics of ``[n,3]`` unit vectors (Sloan 2013, appendix A2)."""
    x, y, z = directions.unbind(-1)
    z2 = z * z
    c1, s1 = x, y
    c2, s2 = x * c1 - y * s1, x * s1 + y * c1
    c3, s3 = x * c2 - y * s2, x * s2 + y * c2
    c4, s4 = x * c3 - y * s3, x * s3 + y * c3
    tmp0a, tmp0b = -1.092548430592079 * z, 0.5462742152960395 + 0 * z
    d3a, d3b, d3c = -2.285228997322329 * z2 + 0.4570457994644658, 1.445305721320277 * z, -0.5900435899266435 + 0 * z
    p12 = z * (1.865881662950577 * z2 - 1.119528997770346)
    p6 = 0.9461746957575601 * z2 - 0.3153915652525201
    p20 = 1.984313483298443 * z * p12 - 1.006230589874905 * p6
    d4a = z * (-4.683325804901025 * z2 + 2.007139630671868)
    d4b = 3.31161143515146 * z2 - 0.47308734787878
    d4c, d4d = -1.770130769779931 * z, 0.6258357354491763 + 0 * z
    one = 0 * z + 1
    columns = [
        0.28209479177387814 * one,
        -0.48860251190292 * y, 0.48860251190292 * z, -0.48860251190292 * x,
        tmp0b * s2, tmp0a * y, p6, tmp0a * x, tmp0b * c2,
        d3c * s3, d3b * s2, d3a * y, p12, d3a * x, d3b * c2, d3c * c3,
        d4d * s4, d4c * s3, d4b * s2, d4a * s1, p20, d4a * c1, d4b * c2, d4c * c3, d4d * c4,
    ]  # fmt: skip
    return torch.stack(columns, -1)


def view_colors(means: Tensor, sh: Tensor, viewmat: Tensor) -> Tensor:
    """Return ``[n,3]`` colours of ``[n,k,3]`` coefficients seen from a camera, not below 0."""
    eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
    basis = harmonics(torch.nn.functional.normalize(means - eye, dim=-1))[:, : sh.shape[1]]
    return torch.clamp(torch.einsum("nk,nkc->nc", basis, sh) + 0.5, min=0)


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """Return covariances ``[n,3,3]`` of quaternions ``[n,4]`` of any length and standard deviations ``[n,3]``."""
    w, (x, y, z) = quats[:, 0], quats[:, 1:].T
    zero = torch.zeros_like(w)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    length = (quats * quats).sum(1)[:, None, None]
    half = (torch.eye(3) + 2 * (w[:, None, None] * cross + cross @ cross) / length) * scales[:, None]
    return half @ half.transpose(1, 2)


def footprints(
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return image positions ``[n,2]``, undilated covariances ``[n,2,2]`` and depths ``[n]``."""
    camera = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = camera[:, 2]
    slopes = camera[:, :2] / depth[:, None]
    focal, centre, size = K[[0, 1], [0, 1]], K[:2, 2], torch.tensor([width, height], dtype=torch.float64)
    spare = 0.15 * size / focal
    clamped = torch.minimum(torch.maximum(slopes, -centre / focal - spare), (size - centre) / focal + spare)
    jacobian = torch.zeros(len(means), 2, 3, dtype=torch.float64)
    jacobian[:, 0, 0], jacobian[:, 1, 1] = focal[0] / depth, focal[1] / depth
    jacobian[:, :, 2] = -focal * clamped / depth[:, None]
    half = jacobian @ viewmat[:3, :3]
    return slopes * focal + centre, half @ covariances(quats, scales) @ half.transpose(1, 2), depth


def render_arrays(
    gaussians: Gaussians, viewmat: np.ndarray, K: np.ndarray, width: int, height: int, **options: Any
) -> Reference:
    """Call :func:`render_reference` with arrays, in the colours that their harmonics show; return arrays."""
    means, quats, scales, opacities, sh0, shN = (t.double() for t in vars(gaussians.to("cpu")).values())
    view, lens = torch.from_numpy(viewmat).double(), torch.from_numpy(K).double()
    colors = view_colors(means, torch.cat([sh0, shN], 1), view)
    drawn = render_reference(means, quats, scales, opacities, colors, view, lens, width, height, **options)
    return Reference(*(part.numpy() for part in vars(drawn).values()))


def render_reference(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    antialiased: bool = False,
    near: float = 0.01,
    far: float = 1e10,
    eps2d: float = 0.3,
    max_alpha: float = 0.99,
) -> Reference:
    """Blend Gaussians of given colours ``[n,3]``, nearest first."""
    means2d, covars2d, depths = footprints(means, quats, scales, viewmat, K, width, height)
    blurred = covars2d + eps2d * torch.eye(2, dtype=torch.float64)
    if antialiased:
        ratio = torch.linalg.det(covars2d) / torch.linalg.det(blurred)
        opacities = opacities * torch.sqrt(torch.clamp(ratio, min=0.005**2))
    conics = torch.linalg.inv(blurred)
    ys, xs = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([xs, ys], -1).double()
    transmittance = torch.ones(height, width, dtype=torch.float64)
    going = torch.ones(height, width, dtype=torch.bool)
    weights = [torch.zeros(height, width, dtype=torch.float64)] * len(means)
    for g in torch.argsort(depths, stable=True).tolist():
        if not near < depths[g] < far:
            continue
        offset = pixels - means2d[g]
        alpha = opacities[g] * torch.exp(-0.5 * torch.einsum("hwi,ij,hwj->hw", offset, conics[g], offset))
        alpha = torch.clamp(alpha, max=max_alpha)
        drawn = going & (alpha >= 1 / 255)
        following = transmittance * (1 - alpha)
        going = going & ~(drawn & (following <= 1e-4))
        drawn = drawn & going
        weights[g] = torch.where(drawn, transmittance * alpha, 0.0)
        transmittance = torch.where(drawn, following, transmittance)
    stack = torch.stack(weights) if weights else torch.zeros(0, height, width, dtype=torch.float64)
    under = torch.tensor(background, dtype=torch.float64)
    image = torch.einsum("nhw,nc->hwc", stack, colors) + transmittance[..., None] * under
    total = stack.sum(0)
    depth = torch.where(total > 0, torch.einsum("nhw,n->hw", stack, depths) / torch.where(total > 0, total, 1.0), 0.0)
    return Reference(image, transmittance, depth, stack)


WIDTH, HEIGHT = 37, 21  # not multiples of a tile
NAMES = ("means", "quats", "scales", "opacities", "sh0", "shN", "viewmats")
BACKGROUND = (0.2, 0.5, 0.9)


def random_gaussians(n: int, degree: int = 0, seed: int = 0) -> Gaussians:
    """Draw Gaussians around (0, 0, 3), of many sizes and quaternions of any length, some outside the image."""
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
    """Return cameras side by side, turned, with unequal focal lengths and the centre beside the middle."""
    viewmats = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    for view in range(count):
        angle = torch.tensor(0.2 - 0.3 * view, dtype=torch.float64)
        viewmats[view, 0, 0] = viewmats[view, 2, 2] = torch.cos(angle)
        viewmats[view, 0, 2], viewmats[view, 2, 0] = torch.sin(angle), -torch.sin(angle)
        viewmats[view, :3, 3] = torch.tensor([-0.4 + 0.5 * view, 0.1, 0.2 * view])
    K = torch.tensor([[33.0, 0, 17.3], [0, 31.0, 11.6], [0, 0, 1]], dtype=torch.float64)
    return Cameras(viewmats, K.repeat(count, 1, 1), WIDTH, HEIGHT)


def pixel_gradients(cameras: Cameras, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Return what a loss might want of images ``[c,h,w,3]`` and alphas ``[c,h,w,1]``."""
    generator = torch.Generator().manual_seed(seed)
    shape = (len(cameras), cameras.height, cameras.width)
    return torch.randn(*shape, 3, generator=generator), torch.randn(*shape, 1, generator=generator)


def leaves(gaussians: Gaussians, cameras: Cameras, dtype: torch.dtype | None = None) -> list[Tensor]:
    """Return tensors of the Gaussians and the view matrices that collect gradients."""
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
    """Return gradients of the images and alphas times :func:`pixel_gradients`, in the order of NAMES, float64."""
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
    """Check that the relative L2 error is below ``most``, tensor by tensor."""
    for name, one, other in zip(NAMES, actual, expected, strict=False):
        assert torch.isfinite(one).all(), name
        error, size = float((one.double() - other).norm()), float(other.norm())
        assert error <= most * size + 1e-9, f"{name}: {error:.2g} of {size:.2g}"
