"""Rendering of CUDA tensors, by gsplat 1.5 (the extra ``gsmerge[cuda]``).

gsplat's conventions are the CPU's: linear scales, opacities in [0, 1], quaternions wxyz of any length, world-to-camera
matrices, pixel centres at +0.5, 0.3 px dilation, directions clamped 15 % outside the image, contributions below 1/255
cut, a pixel stops before its transmittance would reach 1e-4. What differs:

- Alpha is clamped at ``MAX_ALPHA``, on the CPU at 0.99. A pixel in the middle of an opaque Gaussian differs by up to
  0.009 of the contrast with what lies behind it; one that less than a tenth of the light reaches may also stop before
  that Gaussian.
- Gaussians that lie exactly on the near or far plane are drawn.
- gsplat bounds a footprint by its opacity as the CPU does, but in whole pixels; the cut at 1/255 decides in both. Its
  exponential is the fast one of the GPU, so a weight next to the cut may fall on the other side.
- The determinant of a footprint is a difference of products, so needles far below a pixel lose digits.
- Gradients of view matrices agree along rigid motions. Off them they differ where colours depend on the direction: the
  eye is taken from the inverse of the matrix, and on the CPU from its transpose.
- Sums of gradients have no fixed order, so runs differ in the last bits.

gsplat is imported, and compiled where no wheel brought its compiled part, when it is first used.
"""

from __future__ import annotations

import sys
from contextlib import redirect_stdout
from functools import cache
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor

from gsmerge.errors import GsmergeError
from gsmerge.raster.composite import Rendering
from gsmerge.raster.view_plan import EPS2D, Array, check_range
from gsmerge.types import Cameras, Gaussians

# Where gsplat 1.5 clamps alpha, as RasterizeToPixels3DGSFwd.cu, RasterizeToPixels3DGSBwd.cu and
# RasterizeToIndices3DGS.cu have it. The CPU clamps at gsmerge.kernels.raster.blend.MAX_ALPHA.
MAX_ALPHA = 0.999
EVERY_BATCH = 1 << 24  # past the last batch of 256 Gaussians of any tile
INSTALL = 'pip install "gsplat>=1.5,<1.6"'  # as the extra cuda asks for; works beside a wheel and in a checkout

Shape = tuple[Tensor, Tensor, Tensor, Tensor]  # means [n,3], quaternions [n,4], scales [n,3], opacities [n]
Camera = tuple[Tensor, Tensor, int, int]  # world to camera [4,4], intrinsics [3,3], width, height


@cache
def gsplat_problem() -> str | None:
    """Describe in a clause why gsplat cannot be used; None if it can.

    The first call imports gsplat and compiles it where that is needed, which takes minutes. What it
    prints goes to standard error, so that documents on standard output stay whole.
    """
    if find_spec("gsplat") is None:
        return f"gsplat is not installed; {INSTALL}"
    try:
        with redirect_stdout(sys.stderr):
            from gsplat.cuda import _backend
    except Exception as error:  # whatever a compiler or a loader raises
        return f"gsplat cannot be loaded ({first_line(error)})"
    if _backend._C is None:  # gsplat itself would fail with an AttributeError at its first kernel
        return "gsplat has no compiled part, and no CUDA toolkit was found to compile it"
    return None


def first_line(error: BaseException) -> str:
    """Return the class of an exception and the first line of its message as text."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0].strip()}" if lines else type(error).__name__


def _gsplat() -> Any:
    if problem := gsplat_problem():
        raise GsmergeError(f"CUDA tensors are rendered by gsplat, but {problem}")
    import gsplat

    return gsplat


def rasterize(
    shape: Shape,
    colors: Tensor,
    camera: Camera,
    background: Tensor,
    *,
    sh_degree: int | None = None,
    eps2d: float = EPS2D,
    antialiased: bool = False,
    near: float = 0.01,
    far: float = 1e10,
    with_depths: bool = False,
) -> tuple[Tensor, Tensor, Tensor | None, Tensor]:
    """Draw Gaussians into one view by one call of gsplat's ``rasterization``.

    ``colors`` are ``[n,3]``, or with ``sh_degree`` spherical harmonics ``[n,k,3]``; ``background``
    is ``[3]``. Returns the image ``[h,w,3]``, alpha ``[h,w,1]``, mean depth ``[h,w,1]`` without
    gradients or None, and a mask ``[n]`` of the Gaussians with a footprint in the view. Raises
    GsmergeError if gsplat cannot be used.
    """
    means, quats, scales, opacities = (tensor.float() for tensor in shape)
    viewmat, K, width, height = camera
    under = background.to(means)
    if len(means) == 0:  # nothing to launch a kernel for; still a function of the tensors for autograd
        nothing = sum(tensor.float().sum() * 0 for tensor in (*shape, colors, viewmat))
        image, alpha = (row.expand(height, width, -1) + nothing for row in (under, 0 * under[:1]))
        depth = alpha.detach().clone() if with_depths else None
        return image, alpha, depth, torch.zeros(0, dtype=torch.bool, device=means.device)
    images, alphas, details = _gsplat().rasterization(
        means=means, quats=_no_zero(quats), scales=scales, opacities=opacities, colors=colors.float(),
        viewmats=viewmat.float()[None], Ks=K.float()[None], width=width, height=height,
        near_plane=near, far_plane=far, eps2d=eps2d, sh_degree=sh_degree,
        packed=False, backgrounds=under[None].contiguous(),
        render_mode="RGB+ED" if with_depths else "RGB",
        rasterize_mode="antialiased" if antialiased else "classic",
    )  # fmt: skip
    depth = images[0, ..., 3:].detach() if with_depths else None
    return images[0, ..., :3], alphas[0], depth, _reached(details)


def _reached(details: dict[str, Any]) -> Tensor:
    """Read from what gsplat tells of one view ``[n]`` bool: which Gaussians have a footprint there."""
    reached: Tensor = (details["radii"][0] > 0).all(-1)  # [c,n,2], one for each axis
    return reached


def _no_zero(quats: Tensor) -> Tensor:
    """Replace zero quaternions by no rotation, as on the CPU; gsplat would divide by their length."""
    identity = torch.eye(4, device=quats.device)[0]
    return torch.where((quats * quats).sum(1, keepdim=True) > 1e-30, quats, identity)


def peak_weights(shape: Shape, camera: Camera, *, eps2d: float = EPS2D) -> tuple[Tensor, Tensor]:
    """Return each Gaussian's largest blending weight ``[n]`` in a view, and a mask ``[n]`` of Gaussians drawn there.

    gsplat lists the Gaussians of every pixel, nearest first; the weights follow from their footprints. Each listed pair
    takes about 150 bytes.
    """
    means, quats, scales, opacities = (tensor.float() for tensor in shape)
    viewmat, K, width, height = camera
    peaks = torch.zeros(len(means), device=means.device)
    if len(means) == 0:
        return peaks, peaks.bool()
    gsplat = _gsplat()
    _, _, drawn = gsplat.rasterization(
        means=means, quats=_no_zero(quats), scales=scales, opacities=opacities, colors=torch.zeros_like(means),
        viewmats=viewmat.float()[None], Ks=K.float()[None], width=width, height=height, eps2d=eps2d,
        packed=False, backgrounds=torch.zeros(1, 3, device=means.device),
    )  # fmt: skip
    clear = torch.ones(1, height, width, device=means.device)
    ids, pixels, _ = gsplat.rasterize_to_indices_in_range(
        0, EVERY_BATCH, clear, drawn["means2d"], drawn["conics"], drawn["opacities"],
        width, height, drawn["tile_size"], drawn["isect_offsets"], drawn["flatten_ids"],
    )  # fmt: skip
    centres = torch.stack([pixels % width, pixels // width], 1) + 0.5
    dx, dy = (drawn["means2d"][0, ids] - centres).unbind(1)
    xx, xy, yy = drawn["conics"][0, ids].unbind(1)
    falloff = (-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy).exp()
    alphas = (drawn["opacities"][0, ids] * falloff).clamp_max(MAX_ALPHA)
    logs = torch.log1p(-alphas.double())
    before = logs.cumsum(0) - logs  # of all pixels before; less those of the pixel's first entry: of this pixel
    first = torch.ones(len(pixels), dtype=torch.bool, device=means.device)
    first[1:] = pixels[1:] != pixels[:-1]
    starts = torch.nonzero(first)[:, 0]
    weights = alphas * (before - before[starts][first.cumsum(0) - 1]).exp().float()
    return peaks.scatter_reduce_(0, ids, weights, "amax"), _reached(drawn)


def render_cuda(
    gaussians: Gaussians,
    cameras: Cameras,
    background: Array,
    *,
    near: float,
    far: float,
    antialiased: bool,
    with_depths: bool,
) -> Rendering:
    """Render CUDA tensors with gsplat; see :func:`gsmerge.render`. ``background [3]`` is checked already.

    Views are drawn one by one: in one call for several views gsplat copies all harmonics for each, 350 GB for 84 views
    of 14 million Gaussians of degree 4. Positions are first taken relative to the cameras' mean centre in float64, so
    that scenes in geographic coordinates keep their detail.
    """
    check_range(near, far, EPS2D)
    viewmats = cameras.viewmats.double()
    origin = cameras.centres.detach().double().sum(0) / max(len(cameras), 1)
    shifts = viewmats[:, :3, 3:] + viewmats[:, :3, :3] @ origin[:, None]
    local = torch.cat([torch.cat([viewmats[:, :3, :3], shifts], 2), viewmats[:, 3:]], 1)
    means = (gaussians.means.double() - origin).float()
    shape = means, gaussians.quats, gaussians.scales, gaussians.opacities
    sh = torch.cat([gaussians.sh0, gaussians.shN], 1)
    under = torch.from_numpy(background).to(means)
    size = len(cameras), cameras.height, cameras.width
    images = torch.empty(*size, 3, device=means.device)
    alphas = torch.empty(*size, 1, device=means.device)
    depths = torch.empty_like(alphas) if with_depths else None
    for view in range(len(cameras)):
        camera = local[view], cameras.Ks[view], cameras.width, cameras.height
        image, alpha, depth, _ = rasterize(
            shape, sh, camera, under, sh_degree=gaussians.sh_degree,
            near=near, far=far, antialiased=antialiased, with_depths=with_depths,
        )  # fmt: skip
        images[view], alphas[view] = image, alpha
        if depths is not None and depth is not None:
            depths[view] = depth
    return Rendering(images, alphas, depths)


def harmonic_colors(means: Tensor, sh: Tensor, eye: Tensor) -> Tensor:
    """Evaluate the colours ``[n,3]`` of harmonics ``sh [n,k,3]`` seen from ``eye [3]``, clipped at 0."""
    degree = round(sh.shape[1] ** 0.5) - 1
    return (_gsplat().spherical_harmonics(degree, means - eye, sh) + 0.5).clamp_min(0)
