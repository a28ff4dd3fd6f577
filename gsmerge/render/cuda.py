"""Rendering of CUDA tensors, by gsplat (the extra ``gsmerge[cuda]``).

gsplat's conventions are the CPU's: linear scales, opacities in [0, 1], quaternions wxyz of any length, world-to-camera
matrices, pixel centres at +0.5, 0.3 px dilation, directions clamped 15 % outside the image, contributions below 1/255
cut, a pixel stops before its transmittance would reach 1e-4. What differs:

- Alpha is clamped at 0.999 by gsplat 1.5 and at 0.99 by its later sources and by the CPU. A pixel in the middle of an
  opaque Gaussian differs by up to 0.009 of the contrast with what lies behind it; one that less than a tenth of the
  light reaches may also stop before that Gaussian.
- Gaussians that lie exactly on the near or far plane are drawn.
- gsplat bounds a footprint by its opacity as the CPU does, but in whole pixels; the cut at 1/255 decides in both. Its
  exponential is the fast one of the GPU, so a weight next to the cut may fall on the other side.
- The determinant of a footprint is a difference of products, so needles far below a pixel lose digits.
- Gradients of view matrices agree along rigid motions. Off them they differ where colours depend on the direction: the
  eye is taken from the inverse of the matrix, and on the CPU from its transpose.
- Sums of gradients have no fixed order, so runs differ in the last bits.

gsplat is imported when it is first used.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any, Literal

import torch
from torch import Tensor

from gsmerge.errors import GsmergeError
from gsmerge.render.images import Rendering
from gsmerge.render.plan import EPS2D, Array, check_range
from gsmerge.types import Cameras, Gaussians

# Pixels of all views, as many as an aligned scene has Gaussians, from which "auto" takes CUDA. Starting it and
# importing gsplat takes one to three seconds, in which two processors do a scene of this size from end to end.
MIN_PIXELS = 400_000
EVERY_BATCH = 1 << 24  # past the last batch of 256 Gaussians of any tile
INSTALL = 'pip install "gsplat>=1.5,<2"'  # as the extra cuda asks for; works beside a wheel and in a checkout


def cuda_problem() -> str | None:
    """What keeps CUDA devices from being used, as a clause; None where nothing does."""
    if not torch.cuda.is_available():
        return "torch finds no CUDA device"
    if find_spec("gsplat") is None:
        return f"gsplat is not installed; {INSTALL}"
    return None


def usable_device(device: str) -> str:
    """The same of ``"cpu"``, ``"cuda"`` and ``"auto"``, but ``"cpu"`` for ``"auto"`` where CUDA cannot be used.

    Raises:
        ValueError: If ``"cuda"`` is asked for and cannot be used.
    """
    problem = None if device == "cpu" else cuda_problem()
    if device == "cuda" and problem:
        raise ValueError(f'device: expected "cpu" or a CUDA device that can be used, got "cuda", but {problem}')
    return "cpu" if problem else device


def chosen_device(device: str, num_pixels: int) -> Literal["cpu", "cuda"]:
    """``"cpu"`` or ``"cuda"``: the one that ``"auto"`` takes for views of so many pixels, all others as they are."""
    if device != "auto":
        return "cuda" if device == "cuda" else "cpu"
    return "cuda" if num_pixels >= MIN_PIXELS and cuda_problem() is None else "cpu"


def start_cuda(device: torch.device) -> None:
    """Draw one Gaussian, so that loading and compiling are not taken for the time of the first stages."""
    means, quats, colors = (torch.ones(1, size, device=device, requires_grad=True) for size in (3, 4, 3))
    camera = torch.eye(4, device=device)[None], torch.eye(3, device=device)[None] * 8, 8, 8
    with torch.enable_grad():
        shape = means, quats, torch.ones(1, 3, device=device), torch.ones(1, device=device) / 2
        rasterize(shape, colors, camera, torch.zeros(3, device=device))[0].images.sum().backward()


def _gsplat() -> Any:
    try:
        import gsplat
    except ImportError as error:
        raise GsmergeError(f"CUDA tensors are rendered by gsplat, which cannot be imported; {INSTALL}") from error
    return gsplat


def rasterize(
    gaussians: tuple[Tensor, Tensor, Tensor, Tensor],
    colors: Tensor,
    cameras: tuple[Tensor, Tensor, int, int],
    background: Tensor,
    *,
    sh_degree: int | None = None,
    eps2d: float = EPS2D,
    antialiased: bool = False,
    near: float = 0.01,
    far: float = 1e10,
    with_depths: bool = False,
    unit_quats: bool = False,
) -> tuple[Rendering, Tensor]:
    """One call of gsplat's ``rasterization``.

    Args:
        gaussians: Means ``[n,3]``, quaternions ``[n,4]``, scales ``[n,3]`` and opacities ``[n]``.
        colors: ``[n,3]``, taken as they are, or with ``sh_degree`` ``[n,k,3]`` spherical harmonics.
        cameras: World-to-camera matrices ``[c,4,4]``, intrinsics ``[c,3,3]``, width and height.
        background: ``[3]``.
        eps2d: Dilation of the footprints, pixels squared.
        antialiased: Lower the opacity by what the dilation adds to the footprint.
        unit_quats: The quaternions are known to have a length, which need not be checked.

    Returns:
        Images, alphas and depths, on the device of the tensors, the depths without gradients; and ``[c,n]`` bool: which
        Gaussians have a footprint in which view.

    Raises:
        GsmergeError: If gsplat is not installed.
    """
    means, quats, scales, opacities = (tensor.float() for tensor in gaussians)
    viewmats, Ks, width, height = cameras
    backgrounds = background.to(means).expand(len(viewmats), 3).contiguous()
    if len(means) == 0 or len(viewmats) == 0:  # nothing that a kernel could be launched for
        reached = torch.zeros(len(viewmats), len(means), dtype=torch.bool, device=means.device)
        return _empty((*gaussians, colors, viewmats), backgrounds, (height, width), with_depths), reached
    images, alphas, details = _gsplat().rasterization(
        means=means,
        quats=quats if unit_quats else _no_zero(quats),
        scales=scales,
        opacities=opacities,
        colors=colors.float(),
        viewmats=viewmats.float(),
        Ks=Ks.float(),
        width=width,
        height=height,
        near_plane=near,
        far_plane=far,
        eps2d=eps2d,
        sh_degree=sh_degree,
        packed=False,
        backgrounds=backgrounds,
        render_mode="RGB+ED" if with_depths else "RGB",
        rasterize_mode="antialiased" if antialiased else "classic",
    )
    return Rendering(images[..., :3], alphas, images[..., 3:].detach() if with_depths else None), _reached(details)


def _reached(details: dict[str, Any]) -> Tensor:
    """``[c,n]`` bool of what gsplat says of a call: which Gaussians have a footprint in which view."""
    radii = details["radii"]  # one per axis from gsplat 1.5 on
    return (radii > 0).all(-1) if radii.ndim == 3 else radii > 0


def _no_zero(quats: Tensor) -> Tensor:
    """A zero quaternion is no rotation, as on the CPU; gsplat would divide by its length."""
    identity = torch.eye(4, device=quats.device)[0]
    return torch.where((quats * quats).sum(1, keepdim=True) > 1e-30, quats, identity)


def peak_weights(
    gaussians: tuple[Tensor, Tensor, Tensor, Tensor],
    cameras: tuple[Tensor, Tensor, int, int],
    *,
    eps2d: float = EPS2D,
    near: float = 0.01,
) -> tuple[Tensor, Tensor]:
    """Largest blending weight of every Gaussian at some pixel of one view, and which have a footprint there.

    gsplat lists the Gaussians of every pixel, nearest first; their weights follow from its footprints.

    Args:
        gaussians: As of :func:`rasterize`.
        cameras: The same of one view: matrices ``[1,4,4]`` and ``[1,3,3]``, width and height.

    Returns:
        ``[n]`` float32 and ``[n]`` bool.
    """
    means, quats, scales, opacities = (tensor.float() for tensor in gaussians)
    viewmats, Ks, width, height = cameras
    peaks = torch.zeros(len(means), device=means.device)
    if len(means) == 0:
        return peaks, peaks.bool()
    gsplat = _gsplat()
    _, _, drawn = gsplat.rasterization(
        means=means, quats=_no_zero(quats), scales=scales, opacities=opacities, colors=torch.zeros_like(means),
        viewmats=viewmats.float(), Ks=Ks.float(), width=width, height=height, near_plane=near, eps2d=eps2d,
        packed=False, backgrounds=torch.zeros(1, 3, device=means.device),
    )  # fmt: skip
    clear = torch.ones(1, height, width, device=means.device)
    ids, pixels, _ = gsplat.rasterize_to_indices_in_range(
        0, EVERY_BATCH, clear, drawn["means2d"], drawn["conics"], drawn["opacities"],
        width, height, drawn["tile_size"], drawn["isect_offsets"], drawn["flatten_ids"],
    )  # fmt: skip
    ids, pixels = ids.long(), pixels.long()
    centres = torch.stack([pixels % width, pixels // width], 1) + 0.5
    dx, dy = (drawn["means2d"][0, ids] - centres).unbind(1)
    xx, xy, yy = drawn["conics"][0, ids].unbind(1)
    alphas = (drawn["opacities"][0, ids] * (-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy).exp()).clamp_max(0.999)
    logs = torch.log1p(-alphas.double())
    before = logs.cumsum(0) - logs  # of all pixels before; less those of the pixel's first entry: of this pixel
    first = torch.ones(len(pixels), dtype=torch.bool, device=means.device)
    first[1:] = pixels[1:] != pixels[:-1]
    starts = torch.nonzero(first)[:, 0]
    weights = alphas * (before - before[starts][first.cumsum(0) - 1]).exp().float()
    return peaks.scatter_reduce_(0, ids, weights, "amax"), _reached(drawn)[0]


def _empty(tensors: tuple[Tensor, ...], backgrounds: Tensor, size: tuple[int, int], with_depths: bool) -> Rendering:
    """Background alone, still a function of the tensors for autograd."""
    nothing = sum((tensor.float().sum() * 0 for tensor in tensors), torch.zeros((), device=backgrounds.device))
    images = backgrounds[:, None, None].expand(-1, *size, 3) + nothing
    alphas = torch.zeros_like(images[..., :1]) + nothing
    return Rendering(images, alphas, torch.zeros_like(alphas) if with_depths else None)


def render_cuda(
    gaussians: Gaussians, cameras: Cameras, background: Array, *, near: float, far: float, **options: Any
) -> Rendering:
    """:func:`gsmerge.render` by gsplat; same arguments, except for the checked ``[3]`` background.

    Positions are taken relative to the cameras' own centre in float64 first, so that scenes in geographic coordinates
    keep their detail.
    """
    check_range(near, far, EPS2D)
    viewmats = cameras.viewmats.double()
    origin = cameras.centres.detach().double().sum(0) / max(len(cameras), 1)
    shifts = viewmats[:, :3, 3:] + viewmats[:, :3, :3] @ origin[:, None]
    local = torch.cat([torch.cat([viewmats[:, :3, :3], shifts], 2), viewmats[:, 3:]], 1)
    drawn, _ = rasterize(
        (gaussians.means.double() - origin, gaussians.quats, gaussians.scales, gaussians.opacities),
        torch.cat([gaussians.sh0, gaussians.shN], 1),
        (local, cameras.Ks, cameras.width, cameras.height),
        torch.from_numpy(background),
        sh_degree=gaussians.sh_degree,
        near=near,
        far=far,
        **options,
    )
    return drawn


def harmonic_colors(means: Tensor, harmonics: Tensor, eye: Tensor) -> Tensor:
    """``[n,3]`` colours of spherical harmonics ``[n,k,3]`` seen from ``eye``, not below 0."""
    degree = round(harmonics.shape[1] ** 0.5) - 1
    return (_gsplat().spherical_harmonics(degree, means - eye, harmonics) + 0.5).clamp_min(0)
