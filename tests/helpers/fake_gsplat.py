"""gsplat's interface over the slow float64 renderer: strict about what it is given, on any device.

The signature and the checks are those of ``gsplat.rasterization`` 1.5.3, and its kernels' demands (float32, one device)
are added. As there alpha is clamped at 0.999, and what has no footprint has no mean and conic either (NaN here, memory
as it was there).
"""

from __future__ import annotations

import sys
from functools import cache
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

import pytest
import torch
from slow_renderer import footprints, harmonics, render_reference
from torch import Tensor

from gsmerge.raster import cuda

CALLS: list[dict[str, Any]] = []
WEIGHTS: list[Tensor] = []  # of every view of the last call, [n,h,w]


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    CALLS.append(dict(locals()))
    n, c = len(means), len(viewmats)
    assert n > 0, "its kernels take the last of a cumulative sum"
    assert c > 0
    assert (means.shape, quats.shape, scales.shape, opacities.shape) == ((n, 3), (n, 4), (n, 3), (n,))
    assert (viewmats.shape, Ks.shape, backgrounds.shape) == ((c, 4, 4), (c, 3, 3), (c, 3))
    tensors = (means, quats, scales, opacities, colors, viewmats, Ks, backgrounds)
    assert all(tensor.dtype == torch.float32 for tensor in tensors)
    assert len({tensor.device for tensor in tensors}) == 1
    assert backgrounds.is_contiguous()
    assert ((opacities >= 0) & (opacities <= 1)).all(), "not logits"
    assert (scales > 0).all(), "not logarithms"
    assert (quats.norm(dim=1) > 0).all(), "it divides by their length"
    assert torch.equal(viewmats[:, 3], torch.tensor([0.0, 0, 0, 1]).expand(c, 4))
    assert render_mode in ("RGB", "RGB+ED")
    assert rasterize_mode in ("classic", "antialiased")
    assert (radius_clip, packed, camera_model, covars, tile_size) == (0.0, False, "pinhole", None, 16)
    if sh_degree is None:
        assert colors.shape == (n, 3)
    else:
        assert colors.shape == (n, (sh_degree + 1) ** 2, 3)
    doubles = [tensor.double() for tensor in (means, quats, scales, opacities)]
    images, alphas, shapes = [], [], []
    WEIGHTS.clear()
    for viewmat, K, background in zip(viewmats.double(), Ks.double(), backgrounds.double(), strict=True):
        eye = torch.inverse(viewmat)[:3, 3]
        seen = colors.double()
        if sh_degree is not None:
            seen = (spherical_harmonics(sh_degree, means.double() - eye, seen) + 0.5).clamp_min(0)
        drawn = render_reference(
            *doubles, seen, viewmat, K, width, height, antialiased=rasterize_mode == "antialiased",
            near=near_plane, far=far_plane, eps2d=eps2d, max_alpha=0.999,
        )  # fmt: skip
        image = drawn.image + drawn.transmittance[..., None] * background
        images.append(torch.cat([image, drawn.depth[..., None]], -1) if render_mode == "RGB+ED" else image)
        alphas.append(1 - drawn.transmittance[..., None])
        WEIGHTS.append(drawn.weights)
        places, covars2d, _ = footprints(*doubles[:3], viewmat, K, width, height)
        conics = torch.linalg.inv(covars2d + eps2d * torch.eye(2, dtype=torch.float64)).flatten(1)[:, [0, 1, 3]]
        shapes.append((places.float(), conics.float(), opacities))
    depths = torch.einsum("cij,nj->cni", viewmats[:, :3, :3], means)[..., 2] + viewmats[:, 2, 3:]
    radii = (depths > near_plane).int()[..., None].expand(-1, -1, 2)
    means2d, conics, drawn_opacities = (torch.stack(parts) for parts in zip(*shapes, strict=True))
    for values in (means2d, conics):
        values[radii[..., 0] == 0] = torch.nan
    details = {"radii": radii, "means2d": means2d, "conics": conics, "opacities": drawn_opacities}
    tiles = torch.zeros(c, -(-height // tile_size), -(-width // tile_size), dtype=torch.int32)
    details |= {"isect_offsets": tiles, "flatten_ids": depths.flatten().argsort().int(), "tile_size": tile_size}
    return torch.stack(images).float(), torch.stack(alphas).float(), details


def rasterize_to_indices_in_range(
    range_start: int,
    range_end: int,
    transmittances: Tensor,
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gaussians, pixels and images of all weights of the last view that was drawn, pixel by pixel, nearest first."""
    assert range_start == 0
    assert range_end >= 1 << 20, "all batches"
    assert transmittances.shape == (1, image_height, image_width)
    assert (transmittances == 1).all()
    assert (means2d.shape[2], conics.shape[2], opacities.shape) == (2, 3, means2d.shape[:2])
    assert isect_offsets.shape == (1, -(-image_height // tile_size), -(-image_width // tile_size))
    order = flatten_ids.long()
    pixels, places = torch.nonzero(WEIGHTS[0][order].flatten(1).T > 0, as_tuple=True)
    return order[places], pixels, torch.zeros_like(pixels)


def spherical_harmonics(degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None) -> Tensor:
    """Without the half that makes a colour of it."""
    assert masks is None
    assert dirs.shape == (len(coeffs), 3)
    assert (degrees_to_use + 1) ** 2 <= coeffs.shape[1]
    assert dirs.dtype == coeffs.dtype
    basis = harmonics(torch.nn.functional.normalize(dirs, dim=-1))[:, : coeffs.shape[1]]
    return torch.einsum("nk,nkc->nc", basis, coeffs)


@pytest.fixture
def fake_gsplat(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """``import gsplat`` finds the functions above; gives their calls."""
    install(monkeypatch, compiled=object())
    for function in (rasterization, spherical_harmonics, rasterize_to_indices_in_range):
        monkeypatch.setattr(sys.modules["gsplat"], function.__name__, function, raising=False)
    CALLS.clear()
    return CALLS


def install(monkeypatch: pytest.MonkeyPatch, compiled: object) -> None:
    """Put an empty gsplat in place of any that is there; ``compiled`` is its extension, None where it has none."""
    for name in ("gsplat", "gsplat.cuda", "gsplat.cuda._backend"):
        module = ModuleType(name)
        module.__spec__ = ModuleSpec(name, None)
        monkeypatch.setitem(sys.modules, name, module)
    modules = [sys.modules[name] for name in ("gsplat.cuda", "gsplat.cuda._backend")]
    modules[0]._backend, modules[1]._C = modules[1], compiled
    forget(monkeypatch)


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the adapter ask again whether gsplat is there, in this test and after it."""
    monkeypatch.setattr(cuda, "gsplat_problem", cache(cuda.gsplat_problem.__wrapped__))
