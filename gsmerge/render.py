"""Rendering on the CPU: images of Gaussians, and what every Gaussian adds to them.

:func:`render` makes images. The stages that need more than images work per view: :func:`plan_view` projects, sorts
and bins once; :func:`composite`, :func:`splat_adjoint` and :func:`contributions` then walk the same plan with exactly
the same blending weights. The conventions are gsplat's: 0.3 px dilation, alpha clamped at 0.99, contributions below
1/255 cut, a pixel stops before its transmittance would reach 1e-4, pixel centres at +0.5.

All functions give the same result on any number of threads: the work is cut into pieces whose size depends on the
scene alone, and within a piece everything is serial.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from gsmerge.kernels import binning, harmonics, raster
from gsmerge.kernels import project as projection
from gsmerge.threads import parallel_map
from gsmerge.types import Cameras, Gaussians

Array = NDArray[Any]

CHUNK = 1 << 17  # Gaussians per piece of work
BAND = 1 << 17  # intersections per band of tile rows, at least
MAX_SIZE = 1 << 19  # pixels per side: tile columns and rows are kept in 16 bits


@dataclass(frozen=True, eq=False)
class Splats:
    """Gaussians as the kernels take them: contiguous float32 arrays.

    Args:
        means: ``[n,3]`` world positions less ``origin``.
        quats: ``[n,4]`` wxyz.
        scales: ``[n,3]`` linear.
        opacities: ``[n]`` in [0, 1].
        sh0: ``[n,1,3]``.
        shN: ``[n,k-1,3]``.
        origin: ``[3]`` float64, subtracted from the means before they were rounded to float32.
    """

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    sh0: Array
    shN: Array
    origin: Array

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True, eq=False)
class ViewPlan:
    """What is drawn where in one view.

    Args:
        splats: The Gaussians.
        ids: ``[m]`` int32, ascending: the Gaussians that may touch the image. (A few at its border may miss it.)
        footprints: ``[m,8]`` float32, see :mod:`gsmerge.kernels.project`.
        depths: ``[m]`` float32, camera z.
        members: ``[intersections]`` int32 rows of ``ids``, tile after tile, nearest first.
        offsets: ``[tiles+1]`` int64 starts of the tiles' lists.
        eye: ``[3]`` float32, the camera's centre less ``splats.origin``.
        width: Image width, pixels.
        height: Image height, pixels.
    """

    splats: Splats
    ids: Array
    footprints: Array
    depths: Array
    members: Array
    offsets: Array
    eye: Array
    width: int
    height: int

    @property
    def columns(self) -> int:
        """Tiles per row."""
        return -(-self.width // projection.TILE)

    @property
    def lines(self) -> int:
        """Rows of tiles."""
        return -(-self.height // projection.TILE)


@dataclass(frozen=True, eq=False)
class Rendering:
    """Images of c views.

    Args:
        images: ``[c,h,w,3]`` float32 over the background, not clamped at 1.
        alphas: ``[c,h,w,1]`` float32, 1 less the remaining transmittance.
        depths: ``[c,h,w,1]`` float32 mean camera z of what was blended, 0 where nothing was; None if not asked for.
    """

    images: Tensor
    alphas: Tensor
    depths: Tensor | None


def _float32(tensor: Tensor) -> Array:
    return tensor.detach().to("cpu", torch.float32).contiguous().numpy()


def _spread_origin(means: Tensor) -> Array:
    """Zero, or where the Gaussians are when they are so far from zero that float32 would blur them."""
    sample = means[:: max(1, len(means) // 4096)].detach().double()
    sample = sample[torch.isfinite(sample).all(1)]
    if len(sample) == 0:
        return np.zeros(3)
    centre = sample.median(0).values
    spread = (sample - centre).abs().median(0).values.max()
    return centre.cpu().numpy() if centre.abs().max() > 16 * spread else np.zeros(3)


def prepare(gaussians: Gaussians, origin: ArrayLike | None = None) -> Splats:
    """Gaussians as float32 arrays, without copying what already is.

    Args:
        gaussians: n Gaussians; means may be float64, for scenes in geographic coordinates.
        origin: ``[3]`` world point that becomes the arrays' zero. None: the world's zero, unless the scene is far
            away from it compared with its size.

    Returns:
        The arrays.
    """
    start = _spread_origin(gaussians.means) if origin is None else np.array(origin, np.float64).reshape(3)
    means = gaussians.means
    if start.any():
        means = means.double() - torch.from_numpy(start).to(means.device)
    rest = (gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh0, gaussians.shN)
    return Splats(_float32(means), *(_float32(tensor) for tensor in rest), origin=start)


def _camera(viewmat: Array, K: Array, width: int, height: int, eps2d: float, antialiased: bool) -> Array:
    """The numbers of a camera in the kernels' order, all but the depth range."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    # Directions are clamped 15 % of the image outside it, where the first-order projection breaks down (gsplat).
    spare_x, spare_y = 0.15 * width / fx, 0.15 * height / fy
    camera = np.zeros(projection.CAMERA, np.float32)
    camera[projection.ROTATION : projection.SHIFT] = viewmat[:3, :3].ravel()
    camera[projection.SHIFT : projection.FX] = viewmat[:3, 3]
    camera[projection.FX : projection.NEAR] = fx, fy, cx, cy, width, height
    camera[projection.EPS2D] = eps2d
    camera[projection.LIMIT_X : projection.LIMIT_Y] = (width - cx) / fx + spare_x, -cx / fx - spare_x
    camera[projection.LIMIT_Y : projection.ANTIALIASED] = (height - cy) / fy + spare_y, -cy / fy - spare_y
    camera[projection.ANTIALIASED] = antialiased
    return camera


def _ranges(count: int, size: int) -> list[tuple[int, int]]:
    return [(start, min(count, start + size)) for start in range(0, count, size)]


def _visible(splats: Splats, opacities: Array, keep: Array, camera: Array) -> Array:
    """Ids of the Gaussians that may touch the image, ascending."""

    def cull(span: tuple[int, int]) -> Array:
        ids = np.empty(span[1] - span[0] + 1, np.int32)
        return ids[: projection.cull(splats.means, splats.scales, opacities, keep, camera, *span, ids)].copy()

    parts = parallel_map(cull, _ranges(len(splats), CHUNK))
    return np.concatenate(parts) if parts else np.empty(0, np.int32)


def plan_view(
    splats: Splats,
    viewmat: ArrayLike,
    K: ArrayLike,
    width: int,
    height: int,
    *,
    eps2d: float = 0.3,
    antialiased: bool = False,
    near: float = 0.01,
    far: float = 1e10,
    opacities: Array | None = None,
    keep: Array | None = None,
) -> ViewPlan:
    """Project, sort by depth and bin into tiles, for one view.

    Args:
        splats: n Gaussians, from :func:`prepare`.
        viewmat: ``[4,4]`` world to camera.
        K: ``[3,3]`` intrinsics, pixels, without skew.
        width: Image width, pixels.
        height: Image height, pixels.
        eps2d: Dilation of the footprints, pixels squared.
        antialiased: Lower the opacity by what the dilation adds to the footprint (Mip-Splatting's 2D filter).
        near: Nearest depth drawn (exclusive), world units, above 0.
        far: Farthest depth drawn (exclusive).
        opacities: ``[n]`` in place of the Gaussians' own.
        keep: ``[n]`` bool or uint8, False leaves a Gaussian out.

    Returns:
        The plan; its size goes with what is visible, not with n.

    Raises:
        ValueError: If sizes do not fit together, or a number is outside its range.
    """
    viewmat, K = np.array(viewmat, np.float64), np.asarray(K, np.float64)
    if viewmat.shape != (4, 4) or K.shape != (3, 3):
        raise ValueError(f"expected a [4,4] view matrix and [3,3] K, got {list(viewmat.shape)} and {list(K.shape)}")
    if not (0 < width <= MAX_SIZE and 0 < height <= MAX_SIZE):
        raise ValueError(f"expected an image size from 1 to {MAX_SIZE} pixels per side, got {width} x {height}")
    if not (0 < near < far and eps2d >= 0):
        raise ValueError(f"expected 0 < near < far and eps2d >= 0, got {near}, {far} and {eps2d}")
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        raise ValueError(f"expected positive focal lengths, got {K[0, 0]} and {K[1, 1]}")
    opacities = splats.opacities if opacities is None else np.ascontiguousarray(opacities, np.float32)
    keep = np.empty(0, np.uint8) if keep is None else np.ascontiguousarray(keep).view(np.uint8)
    if opacities.shape != (len(splats),) or len(keep) not in (0, len(splats)):
        raise ValueError(f"expected {len(splats)} opacities and keep flags, got {len(opacities)} and {len(keep)}")

    viewmat[:3, 3] += viewmat[:3, :3] @ splats.origin
    camera = _camera(viewmat, K, width, height, eps2d, antialiased)
    camera[projection.NEAR], camera[projection.FAR] = near, far
    ids = _visible(splats, opacities, keep, camera)
    m, columns, lines = len(ids), -(-width // projection.TILE), -(-height // projection.TILE)
    footprints, depths = np.empty((m, projection.FOOTPRINT), np.float32), np.empty(m, np.float32)
    boxes = np.empty((m, 4), np.int16)

    def project(span: tuple[int, int]) -> None:
        part = slice(*span)
        lnops = np.log(np.minimum(opacities[ids[part]], np.float32(1)))
        projection.project(
            splats.means, splats.quats, splats.scales, lnops, ids[part], camera,
            footprints[part], depths[part], boxes[part],
        )  # fmt: skip

    parallel_map(project, _ranges(m, CHUNK))
    order = binning.depth_order(depths.view(np.uint32))
    members, offsets = _bin(order, boxes, lines, columns)
    eye = (-viewmat[:3, :3].T @ viewmat[:3, 3]).astype(np.float32)
    return ViewPlan(splats, ids, footprints, depths, members, offsets, eye, width, height)


def _bin(order: Array, boxes: Array, lines: int, columns: int) -> tuple[Array, Array]:
    """Tile lists and their starts."""
    # One gather in advance, 8 bytes a box: in the loops below every miss would be paid in full.
    boxes = boxes.view(np.uint64)[order, 0].view(np.int16).reshape(-1, 4)
    spans = _ranges(len(order), CHUNK)
    counts = np.array(
        parallel_map(lambda span: binning.count_tiles(boxes[slice(*span)], lines, columns), spans), np.int64
    ).reshape(-1, lines * columns)
    offsets = np.concatenate([[0], np.cumsum(counts.sum(0))])
    cursors = offsets[:-1] + np.cumsum(counts, 0) - counts
    members = np.empty(offsets[-1], np.int32)

    def deal(piece: tuple[tuple[int, int], Array]) -> None:
        part = slice(*piece[0])
        binning.deal_tiles(order[part], boxes[part], columns, piece[1], members)

    parallel_map(deal, zip(spans, cursors, strict=True))
    return members, offsets


def _bands(offsets: Array, columns: int) -> list[tuple[int, int]]:
    """Bands of tile rows with about equally many intersections: few enough to pay, many enough to share out."""
    lines = (len(offsets) - 1) // columns
    num = int(min(lines, max(1, offsets[-1] // BAND)))
    cuts = np.searchsorted(offsets[::columns], offsets[-1] * np.arange(1, num) / num)
    edges = np.unique(np.concatenate([[0], cuts, [lines]]))
    return [(int(a), int(b)) for a, b in zip(edges[:-1], edges[1:], strict=True)]


def _tile_ranges(plan: ViewPlan) -> list[tuple[int, int]]:
    columns = plan.columns
    return [(first * columns, last * columns) for first, last in _bands(plan.offsets, columns)]


def _background(background: ArrayLike) -> Array:
    try:
        return np.broadcast_to(np.asarray(background, np.float32), (3,)).copy()
    except (TypeError, ValueError):
        raise ValueError(f"expected a background of 1 or 3 numbers, got {background!r}") from None


def _view_colors(plan: ViewPlan) -> Array:
    colors, splats = np.empty((len(plan.ids), 3), np.float32), plan.splats
    parallel_map(
        lambda span: harmonics.view_colors(splats.means, splats.sh0, splats.shN, plan.ids, plan.eye, *span, colors),
        _ranges(len(plan.ids), CHUNK),
    )
    return colors


def _blend(plan: ViewPlan, colors: Array, background: Array) -> tuple[Array, Array]:
    image = np.empty((plan.height, plan.width, 3), np.float32)
    transmittance = np.empty((plan.height, plan.width), np.float32)
    parallel_map(
        lambda tiles: raster.blend(
            plan.footprints, colors, plan.members, plan.offsets, plan.columns, *tiles, background, image, transmittance
        ),
        _tile_ranges(plan),
    )
    return image, transmittance


def composite(plan: ViewPlan, colors: Array | None = None, background: ArrayLike = 0.0) -> tuple[Array, Array]:
    """Blend the Gaussians of a view front to back.

    Args:
        plan: The view.
        colors: ``[n,3]`` of all Gaussians, any sign, taken as they are. None: their spherical harmonics seen from
            this view, not below 0.
        background: What shines through, 1 or 3 numbers.

    Returns:
        ``[h,w,3]`` image and ``[h,w]`` remaining transmittance, float32.

    Raises:
        ValueError: If ``colors`` or ``background`` has another shape.
    """
    if colors is None:
        return _blend(plan, _view_colors(plan), _background(background))
    if colors.shape != (len(plan.splats), 3):
        raise ValueError(f"colors: expected shape {[len(plan.splats), 3]}, got {list(colors.shape)}")
    return _blend(plan, np.ascontiguousarray(colors[plan.ids], np.float32), _background(background))


def splat_adjoint(plan: ViewPlan, image: Array) -> Array:
    """Sum, for every Gaussian, its blending weight times the image over the pixels.

    The transpose of :func:`composite` (without background) as a linear map from colours to images.

    Args:
        plan: The view.
        image: ``[h,w,c]``; four channels cost little more than one.

    Returns:
        ``[n,c]`` float32.

    Raises:
        ValueError: If the image has another size than the view.
    """
    if image.ndim != 3 or image.shape[:2] != (plan.height, plan.width):
        raise ValueError(f"image: expected shape {[plan.height, plan.width, 'c']}, got {list(image.shape)}")
    sums = np.zeros((len(plan.splats), image.shape[2]), np.float32)
    slots = np.empty((len(plan.members), raster.CHANNELS), np.float32)
    for first in range(0, image.shape[2], raster.CHANNELS):
        part = np.ascontiguousarray(image[..., first : first + raster.CHANNELS], np.float32)
        parallel_map(
            lambda tiles, part=part: raster.weighted_sums(
                plan.footprints, plan.members, plan.offsets, plan.columns, *tiles, part, slots
            ),
            _tile_ranges(plan),
        )
        raster.add_slots(plan.members, slots, plan.ids, first, sums)
    return sums


def contributions(plan: ViewPlan) -> tuple[Array, Array]:
    """Sum and maximum over the pixels of every Gaussian's blending weight.

    Args:
        plan: The view.

    Returns:
        ``[n]`` sums (pixels) and ``[n]`` maxima, float32; 0 for Gaussians that are not seen.
    """
    parts = np.zeros((2, len(plan.ids)), np.float32)
    raster.contributions(
        plan.footprints, plan.members, plan.offsets, plan.columns, plan.height, plan.width, parts[0], parts[1]
    )
    mass, peak = np.zeros((2, len(plan.splats)), np.float32)
    mass[plan.ids], peak[plan.ids] = parts
    return mass, peak


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    background: float | Sequence[float] | Tensor = 0.0,
    *,
    antialiased: bool = False,
    near: float = 0.01,
    far: float = 1e10,
    with_depths: bool = False,
) -> Rendering:
    """Render Gaussians into every camera.

    Args:
        gaussians: n Gaussians, SH degrees 0 to 4.
        cameras: c cameras; their intrinsics' skew is ignored.
        background: What shines through, 1 or 3 numbers.
        antialiased: Lower the opacity of small Gaussians by what the dilation adds to them.
        near: Nearest depth drawn, world units, above 0.
        far: Farthest depth drawn.
        with_depths: Also render the mean depth.

    Returns:
        Images, alphas and, if asked for, depths.

    Raises:
        ValueError: If the background or the depth range makes no sense.
    """
    # Around the cameras' own centre, in float64, so that scenes in geographic coordinates keep their detail.
    origin = cameras.centres.double().mean(0).cpu().numpy() if len(cameras) else np.zeros(3)
    splats = prepare(gaussians, origin)
    viewmats, Ks = cameras.viewmats.double().cpu().numpy(), cameras.Ks.double().cpu().numpy()
    shape = (len(cameras), cameras.height, cameras.width)
    images, alphas = np.empty((*shape, 3), np.float32), np.empty((*shape, 1), np.float32)
    depths = np.zeros((*shape, 1), np.float32) if with_depths else None
    under = _background(background)

    def one(view: int) -> None:
        plan = plan_view(
            splats, viewmats[view], Ks[view], cameras.width, cameras.height,
            antialiased=antialiased, near=near, far=far,
        )  # fmt: skip
        images[view], transmittance = _blend(plan, _view_colors(plan), under)
        alphas[view, ..., 0] = 1 - transmittance
        if depths is not None:
            colors = np.repeat(plan.depths[:, None], 3, 1)
            weighted = _blend(plan, colors, np.zeros(3, np.float32))[0][..., :1]
            np.divide(weighted, alphas[view], out=depths[view], where=alphas[view] > 0)

    if len(cameras) == 1:
        one(0)  # not through the pool, so that the pieces of the one view can share it
    else:
        parallel_map(one, range(len(cameras)))
    return Rendering(
        torch.from_numpy(images), torch.from_numpy(alphas), None if depths is None else torch.from_numpy(depths)
    )
