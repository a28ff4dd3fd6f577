"""Rendering of Gaussians into every camera, and what a scene's views see: weights, depths, tile lists."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from threading import Lock
from typing import Any

import numpy as np

from gsmerge.arguments import check_arguments
from gsmerge.arrays import Array, like
from gsmerge.kernels.raster.project import TILE
from gsmerge.raster.composite import (
    Rendering,
    background_color,
    blend,
    contributions,
    draw_views,
    prepare_views,
    view_colors,
)
from gsmerge.raster.photos import NEAR_PLANE
from gsmerge.raster.tiled_view import FAR_PLANE, TiledView, make_splats, tile_view
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Gaussians, Scene

ONE_AT_A_TIME = 4_000_000  # Gaussians; a tiled view is as large as they are
BAND_PIXELS = 1 << 22  # of a picture that are in memory as floating-point numbers; larger ones are drawn in bands
MIN_ALPHA = 0.5  # opacity of a pixel from which it counts when superpixels are merged


def _needs_gradient(gaussians: Gaussians, cameras: Cameras) -> bool:
    import torch

    return torch.is_grad_enabled() and any(t.requires_grad for t in (*vars(gaussians).values(), cameras.viewmats))


@check_arguments
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    background: float | Sequence[float] | Array = 0.0,
    *,
    antialiased: bool = False,
    near: float = 0.01,
    far: float = FAR_PLANE,
    with_depths: bool = False,
) -> Rendering:
    """Render Gaussians into every camera.

    Arrays give arrays, tensors give tensors. The CPU renders: tensors on a GPU are copied to it, and
    the results, and gradients, back.

    Of tensors, images and alphas are differentiable with respect to the Gaussians and the view matrices;
    depths and intrinsics are not. No gradient passes where alpha is clamped at 0.99 or a colour at 0.

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

    Example:
        >>> scene = gsmerge.read_scene("demo")
        >>> gsmerge.render(scene.gaussians, scene.cameras, background=1.0).images.shape
        (5, 32, 48, 3)
    """
    under = background_color(background.detach().cpu() if hasattr(background, "detach") else background)
    options: dict[str, Any] = {"antialiased": antialiased, "near": near, "far": far}
    values = (*vars(gaussians).values(), cameras.viewmats, cameras.Ks)
    tensors = [value for value in values if not isinstance(value, np.ndarray)]
    if tensors:  # torch is imported only for those who have tensors
        gaussians, cameras = gaussians.to("cpu"), cameras.to("cpu")
    if tensors and _needs_gradient(gaussians, cameras):
        from gsmerge.raster.autograd import render_tensors  # only for those who train

        drawn = render_tensors(gaussians, cameras, under, with_depths=with_depths, **options)
    else:
        tile_one = _tiler(gaussians, cameras, options)
        drawn = draw_views(tile_one, (len(cameras), cameras.height, cameras.width), under, with_depths)
    if not tensors:
        return drawn
    parts: list[Any] = [None if part is None else like(part, tensors[0]) for part in vars(drawn).values()]
    return Rendering(*parts)


def render_in_turn(
    gaussians: Gaussians,
    cameras: Cameras,
    background: float | Sequence[float] = 0.0,
    *,
    at_once: int,
    near: float = 0.01,
    convert: Callable[[np.ndarray], np.ndarray] = np.asarray,
    columns: Sequence[tuple[int, int]] | None = None,
) -> Iterator[np.ndarray]:
    """Yield the images ``[h,w,3]`` of :func:`render`, bit for bit, each changed pixel by pixel by ``convert``.

    At most ``at_once`` images are in memory; large images are drawn and converted in bands. Of each image at least
    its ``columns`` of pixels, first and last + 1, are drawn; the background is in the others.
    """
    under = background_color(background)
    tile_one = _tiler(gaussians, cameras, {"near": near}, columns)
    lines, tall = -(-cameras.height // TILE), max(1, BAND_PIXELS // (cameras.width * TILE))
    if lines > tall:
        bands = [(first, min(first + tall, lines)) for first in range(0, lines, tall)]
        for view in range(len(cameras)):
            parts = (tile_one(view, band) for band in bands)
            yield np.concatenate([convert(blend(part, view_colors(part), under)[0]) for part in parts])
        return
    for first in range(0, len(cameras), at_once):
        count = min(at_once, len(cameras) - first)
        shape = count, cameras.height, cameras.width
        yield from map(convert, draw_views(tile_one, shape, under, with_depths=False, first=first).images)


def _tiler(
    gaussians: Gaussians, cameras: Cameras, options: Mapping[str, Any], columns: Sequence[tuple[int, int]] | None = None
) -> Callable[..., TiledView]:
    """Prepare the Gaussians for cameras, and return what tiles each view by its number, or a band of it."""
    splats, viewmats, Ks = prepare_views(gaussians, cameras)
    spans = None if columns is None else [(left // TILE, -(-right // TILE)) for left, right in columns]  # of tiles

    def tile_one(view: int, band: tuple[int, int] | None = None) -> TiledView:
        camera = viewmats[view], Ks[view], cameras.width, cameras.height
        return tile_view(splats, *camera, band=band, columns=None if spans is None else spans[view], **options)

    return tile_one


def seen_weights(scene: Scene) -> np.ndarray:
    """Measure each Gaussian's largest summed blending weight in one view, ``[n]`` float32, pixels."""
    most, lock = np.zeros(len(scene.gaussians), np.float32), Lock()

    def one_view(_: int, tiled: TiledView) -> None:
        sums, _peaks = contributions(tiled)
        with lock:
            np.maximum(most, sums, out=most)

    tile_views(scene, one_view)
    return most


def tile_views(scene: Scene, use: Callable[[int, TiledView], None], views: Sequence[int] | None = None) -> None:
    """Call ``use(view, tiled)`` with every view, or some ``views``, tiled, in parallel if memory allows."""
    splats, cameras = make_splats(scene.gaussians), scene.cameras
    viewmats, Ks = cameras.viewmats.astype(np.float64), cameras.Ks.astype(np.float64)

    def one_view(view: int) -> None:
        use(view, tile_view(splats, viewmats[view], Ks[view], cameras.width, cameras.height, near=NEAR_PLANE))

    ids = range(len(scene)) if views is None else views
    if len(splats) <= ONE_AT_A_TIME:
        parallel_map(one_view, ids)
        return
    for view in ids:
        one_view(view)


def seen_depths(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Render the mean depth ``[v,h,w]`` of every pixel, and a mask ``[v,h,w]`` of mostly opaque pixels."""
    drawn = render(scene.gaussians, scene.cameras, near=NEAR_PLANE, with_depths=True)
    assert drawn.depths is not None
    return drawn.depths[..., 0], drawn.alphas[..., 0] > MIN_ALPHA


def thin_out(gaussians: Gaussians, count: int) -> Gaussians:
    """Return every k-th Gaussian, at most ``count``, enlarged so that the total area stays the same."""
    step = max(1, -(-len(gaussians) // count))
    few = gaussians[::step]
    return Gaussians(few.means, few.quats, few.scales * math.sqrt(step), few.opacities, few.sh0, few.shN)
