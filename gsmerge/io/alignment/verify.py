"""Whether row ``(v·H + y)·W + x`` of a scene really is pixel (x, y) of view v, and if not, why not."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gsmerge.io.cameras.camera_file import C2W_OPENGL, CONVENTIONS, Convention, from_viewmats, to_viewmats
from gsmerge.types import Cameras, Gaussians

MAX_SAMPLES = 20_000  # points tested per view
MAX_MEDIAN_PX = 1.5  # backbones move a Gaussian within its pixel, and some a little beyond


@dataclass(frozen=True)
class Alignment:
    """How well every view's own Gaussians project into their own pixels.

    Args:
        median_px: Median distance from the pixel centre per view, pixels; inf where most are behind the camera,
            NaN where a view has no finite Gaussian.
        share_in_front: Share of all tested Gaussians with positive depth in their own view.
        share_within_1px: Share of all tested Gaussians at most one pixel from their pixel's centre.
        limit_px: What the medians are compared with.
        ok: Whether every view's median is below the limit and most Gaussians are in front.
    """

    median_px: tuple[float, ...]
    share_in_front: float
    share_within_1px: float
    limit_px: float
    ok: bool

    @property
    def worst_px(self) -> float:
        """The largest median of a view."""
        return max((m for m in self.median_px if not math.isnan(m)), default=math.nan)


@dataclass(frozen=True)
class _Sample:
    """Some pixels of every view: ``points`` [v,s,3] float64, ``pixels`` [s,2] centres, ``valid`` [v,s]."""

    points: Tensor
    pixels: Tensor
    valid: Tensor


def check_alignment(gaussians: Gaussians, cameras: Cameras, valid: Tensor) -> Alignment:
    """Project a sample of every view's own Gaussians into that view.

    Args:
        gaussians: V·H·W rows, thought to be in view-major, row-major order.
        cameras: The V views.
        valid: ``[V,H,W]`` or ``[V·H·W]`` bool; rows that are False are not tested.

    Raises:
        ValueError: If the number of rows is not V·H·W.
    """
    return _measure(_sample(gaussians, cameras, valid), cameras)


def pixel_limit(width: int, height: int) -> float:
    """Median distance in pixels up to which Gaussians are taken to be those of their pixels."""
    return max(0.5, min(MAX_MEDIAN_PX, 0.1 * math.sqrt(width * height)))


def _sample(gaussians: Gaussians, cameras: Cameras, valid: Tensor) -> _Sample:
    views, width, pixels = len(cameras), cameras.width, cameras.width * cameras.height
    if len(gaussians) != views * pixels:
        raise ValueError(f"expected {views} x {cameras.height} x {width} Gaussians, got {len(gaussians)}")
    step = -(-pixels // MAX_SAMPLES)
    while math.gcd(step, width) > 1:  # a step that divides the width would only see some columns
        step += 1
    ids = torch.arange(0, pixels, step)
    centres = torch.stack([ids % width, ids.div(width, rounding_mode="floor")], 1).double() + 0.5
    points = gaussians.means.reshape(views, pixels, 3)[:, ids].double()
    return _Sample(points, centres, valid.reshape(views, pixels)[:, ids])


def _measure(sample: _Sample, cameras: Cameras) -> Alignment:
    limit = pixel_limit(cameras.width, cameras.height)
    viewmats, Ks = cameras.viewmats.double(), cameras.Ks.double()
    camera = sample.points @ viewmats[:, :3, :3].transpose(1, 2) + viewmats[:, None, :3, 3]
    image = camera @ Ks.transpose(1, 2)
    in_front = camera[..., 2] > 0
    distance = (image[..., :2] / image[..., 2:] - sample.pixels).norm(dim=-1)
    distance = torch.where(in_front, distance, torch.inf).nan_to_num(nan=torch.inf, posinf=torch.inf)
    median = [float(d[ok].median()) if ok.any() else math.nan for d, ok in zip(distance, sample.valid, strict=True)]
    tested = max(1, int(sample.valid.sum()))
    share = float((in_front & sample.valid).sum()) / tested
    near = float(((distance <= 1) & sample.valid).sum()) / tested
    fits = [m < limit for m in median if not math.isnan(m)]
    return Alignment(tuple(median), share, near, limit, bool(fits) and all(fits) and share > 0.5)


def explain_misalignment(
    gaussians: Gaussians,
    cameras: Cameras,
    valid: Tensor,
    convention: Convention = C2W_OPENGL,
) -> str | None:
    """Name the other reading of the cameras or of the row order under which the scene would fit.

    Args:
        gaussians: As for :func:`check_alignment`.
        cameras: The views, read under ``convention``.
        valid: As for :func:`check_alignment`.
        convention: How the camera file's format stores poses.

    Returns:
        What would fit, in words; None if nothing that is known does.
    """
    sample = _sample(gaussians, cameras, valid)
    for words, other in _other_cameras(sample, cameras, convention):
        if _measure(sample, other).ok:
            return words
    for words, order in _other_orders(len(cameras), cameras.height, cameras.width):
        if _measure(_sample(gaussians[order], cameras, valid.reshape(-1)[order]), cameras).ok:
            return words
    swapped = replace(cameras, width=cameras.height, height=cameras.width)
    if check_alignment(gaussians, swapped, valid).ok:
        return "the cameras fit with width and height swapped"
    return None


def _other_cameras(sample: _Sample, cameras: Cameras, convention: Convention) -> Iterator[tuple[str, Cameras]]:
    given = cameras.viewmats.double().numpy()
    stored = from_viewmats(given, convention)
    for other in CONVENTIONS:
        if other != convention:
            viewmats = torch.from_numpy(to_viewmats(stored, other))
            yield _reading(other, convention), replace(cameras, viewmats=viewmats)
    turned = given.copy()
    turned[:, :3, :3] = given[:, :3, :3].transpose(0, 2, 1)
    turned[:, :3, 3] = -np.einsum("vij,vj->vi", turned[:, :3, :3], cameras.centres.double().numpy())
    yield "the cameras fit with their rotations transposed", replace(cameras, viewmats=torch.from_numpy(turned))
    for axis, words in ((1, "y axis flipped (rows counted from the bottom)"), (0, "x axis flipped (mirrored images)")):
        mirrored = torch.from_numpy(given.copy())
        mirrored[:, axis] *= -1
        yield f"the cameras fit with the {words}", replace(cameras, viewmats=mirrored)
    scale = _camera_scale(sample, cameras)
    if scale > 0:
        scaled = torch.from_numpy(given.copy())
        scaled[:, :3, 3] *= scale
        yield f"the cameras fit with their positions scaled by {scale:.4g}", replace(cameras, viewmats=scaled)


def _reading(other: Convention, convention: Convention) -> str:
    return (
        f"the poses fit when read as {other[0]} matrices with {other[1]} axes, "
        f"where this format has {convention[0]} with {convention[1]} axes"
    )


def _camera_scale(sample: _Sample, cameras: Cameras) -> float:
    """The factor s of the camera positions that brings every mean nearest to its pixel's ray.

    With ray direction d, centre c and mean X, (X - s c) x d = 0 for all; so s = sum e·g / sum e·e with
    e = c x d and g = X x d. 0 where the centres do not determine it.
    """
    ones = torch.ones(len(sample.pixels), 1, dtype=torch.float64)
    rays = torch.cat([sample.pixels, ones], 1) @ torch.linalg.inv(cameras.Ks.double()).transpose(1, 2)
    rays = torch.nn.functional.normalize(rays @ cameras.viewmats[:, :3, :3].double(), dim=-1)
    centres = cameras.centres.double()[:, None].expand_as(rays)
    e, g = torch.linalg.cross(centres, rays), torch.linalg.cross(sample.points, rays)
    weight = sample.valid.double()
    bottom = ((e * e).sum(-1) * weight).sum()
    return float(((e * g).sum(-1) * weight).sum() / bottom) if bottom > 0 else 0.0


def _other_orders(views: int, height: int, width: int) -> Iterator[tuple[str, Tensor]]:
    """Permutations that bring rows of another order into view-major, row-major order."""
    rows = torch.arange(views * height * width)
    yield (
        "the rows fit in the order row, column, view (view fastest)",
        rows.reshape(height, width, views).permute(2, 0, 1).reshape(-1),
    )
    yield (
        "the rows fit in the order view, column, row (column-major)",
        rows.reshape(views, width, height).permute(0, 2, 1).reshape(-1),
    )
    yield (
        "the rows fit with the views in reverse order",
        rows.reshape(views, height, width).flip(0).reshape(-1),
    )
