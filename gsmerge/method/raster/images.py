"""Render Gaussians into every camera, or tile every view of a scene."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from gsmerge.arrays import Array, like
from gsmerge.method.kernels.raster.project import TILE
from gsmerge.method.raster.composite import Rendering, background_color, blend, draw_views, prepare_views, view_colors
from gsmerge.method.raster.photos import NEAR_PLANE
from gsmerge.method.raster.tiled_view import FAR_PLANE, Splats, TiledView, tile_view
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Gaussians

# Scenes of more than ONE_AT_A_TIME Gaussians are tiled view by view, because a tiled view takes about as much memory as
# the Gaussians
ONE_AT_A_TIME = 4_000_000
BAND_PIXELS = 1 << 22  # largest number of pixels drawn at once; larger images are drawn in bands to save memory


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    background: float | Sequence[float] | Array = 0.0,
    *,
    antialiased: bool | None = None,
    near: float = NEAR_PLANE,
    far: float = FAR_PLANE,
    with_depths: bool = False,
) -> Rendering:
    """Render Gaussians into every camera; see :func:`gsmerge.drawing.render_views.render` for arguments and gradients.

    ``near`` and ``far`` are depths in the unit of the Gaussians, by default for the canonical frame.
    """
    background_rgb = background_color(background.detach().cpu() if hasattr(background, "detach") else background)
    options: dict[str, Any] = {"near": near, "far": far}
    options["antialiased"] = cameras.antialiased if antialiased is None else antialiased
    values = (*vars(gaussians).values(), cameras.viewmats, cameras.Ks)
    tensors = [value for value in values if not isinstance(value, np.ndarray)]
    needs_gradient = False
    if tensors:
        import torch  # only if there are tensors

        gaussians = gaussians.to("cpu")
        cameras = cameras.to("cpu")
        moving = (*vars(gaussians).values(), cameras.viewmats)
        needs_gradient = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in moving)
    if needs_gradient:
        from gsmerge.method.raster.autograd import render_tensors  # here because only training needs it

        drawn = render_tensors(gaussians, cameras, background_rgb, with_depths=with_depths, **options)
    else:
        tile_one = _make_tiler(gaussians, cameras, options)
        drawn = draw_views(tile_one, (len(cameras), cameras.height, cameras.width), background_rgb, with_depths)
    if not tensors:
        return drawn
    outputs: list[Any] = [None if array is None else like(array, tensors[0]) for array in vars(drawn).values()]
    return Rendering(*outputs)


def render_in_batches(
    gaussians: Gaussians,
    cameras: Cameras,
    background: float | Sequence[float] | None = 0.0,
    *,
    at_once: int,
    near: float = NEAR_PLANE,
    convert: Callable[[np.ndarray], np.ndarray] = np.asarray,
    columns: Sequence[tuple[int, int]] | None = None,
) -> Iterator[np.ndarray]:
    """Yield the images ``[h,w,3]`` of :func:`render`, with the same bits, each after ``convert``.

    If ``background`` is None, the images ``[h,w,4]`` have alpha, by which their colours are multiplied.
    At most ``at_once`` images are in memory. Large images are drawn and converted in bands, so ``convert`` has to work
    pixel by pixel. ``columns`` has, for each image, the first column of pixels to draw and the column after the last.
    Tiles outside the columns to draw may show the background only.
    """
    background_rgb = background_color(background or 0.0)
    tile_one = _make_tiler(gaussians, cameras, {"antialiased": cameras.antialiased, "near": near}, columns)

    def finish(image: np.ndarray, alpha: np.ndarray) -> np.ndarray:
        """Return the image, with alpha if there is no background."""
        return image if background is not None else np.concatenate([image, alpha[..., None]], -1)

    lines = -(-cameras.height // TILE)
    band_lines = max(1, BAND_PIXELS // (cameras.width * TILE))
    if lines > band_lines:
        bands = [(first_line, min(first_line + band_lines, lines)) for first_line in range(0, lines, band_lines)]
        for view in range(len(cameras)):
            tiled_bands = (tile_one(view, band) for band in bands)
            blended = (blend(tiled, view_colors(tiled), background_rgb) for tiled in tiled_bands)
            yield np.concatenate([convert(finish(image, 1 - transmittance)) for image, transmittance in blended])
        return
    for first_view in range(0, len(cameras), at_once):
        count = min(at_once, len(cameras) - first_view)
        shape = count, cameras.height, cameras.width
        drawn = draw_views(tile_one, shape, background_rgb, with_depths=False, first_view=first_view)
        for image, alpha in zip(drawn.images, drawn.alphas[..., 0], strict=True):
            yield convert(finish(image, alpha))


def _make_tiler(
    gaussians: Gaussians, cameras: Cameras, options: Mapping[str, Any], columns: Sequence[tuple[int, int]] | None = None
) -> Callable[..., TiledView]:
    """Return a function ``tile_one(view, band)`` that tiles the view of a camera, or a band of it.

    See :func:`tile_view` for ``options`` and bands, and :func:`render_in_batches` for ``columns``, which are in pixels.
    """
    splats, viewmats, Ks = prepare_views(gaussians, cameras)
    tile_columns = None if columns is None else [(left // TILE, -(-right // TILE)) for left, right in columns]

    def tile_one(view: int, band: tuple[int, int] | None = None) -> TiledView:
        """Tile a view, or only the lines of tiles in ``band``."""
        camera = viewmats[view], Ks[view], cameras.width, cameras.height
        return tile_view(splats, *camera, band=band, columns=tile_columns[view] if tile_columns else None, **options)

    return tile_one


def tile_camera(
    splats: Splats, cameras: Cameras, view: int, near: float = NEAR_PLANE, tiles: np.ndarray | None = None
) -> TiledView:
    """Tile the view of one camera, as its mark says that Gaussians are drawn; ``tiles``: see :func:`tile_view`."""
    camera = cameras.viewmats[view].astype(np.float64), cameras.Ks[view].astype(np.float64)
    return tile_view(
        splats, *camera, cameras.width, cameras.height, antialiased=cameras.antialiased, near=near, tiles=tiles
    )


def tile_views(
    gaussians: Gaussians,
    cameras: Cameras,
    use: Callable[[int, TiledView], None],
    views: Sequence[int] | None = None,
    tiles: Mapping[int, np.ndarray] | None = None,
) -> None:
    """Tile all views, or only ``views``, and call ``use(view, tiled)`` for each, in parallel if memory allows.

    ``tiles`` has masks of the tiles that have to be complete, see :func:`tile_view`; views without one are complete.
    """
    view_ids = range(len(cameras)) if views is None else views
    if not len(view_ids):
        return
    splats, *_ = prepare_views(gaussians, cameras)

    def tile_and_use(view: int) -> None:
        """Tile one view, and call ``use`` for it."""
        use(view, tile_camera(splats, cameras, view, tiles=None if tiles is None else tiles.get(view)))

    if len(splats) <= ONE_AT_A_TIME:
        parallel_map(tile_and_use, view_ids)
        return
    for view in view_ids:
        tile_and_use(view)


def tiles_near(pixels: np.ndarray, distance: float) -> np.ndarray:
    """Return a mask ``[tile_height,tile_width]`` of the tiles within ``distance`` pixels of a mask ``pixels [h,w]``."""
    height, width = pixels.shape
    tiles = np.zeros((-(-height // TILE), -(-width // TILE)), np.uint8)
    lines, columns = np.nonzero(pixels)
    tiles[lines // TILE, columns // TILE] = 1
    around = 2 * math.ceil(distance / TILE) + 1
    return np.asarray(cv2.dilate(tiles, np.ones((around, around), np.uint8)) > 0)


def thin_out(gaussians: Gaussians, count: int) -> Gaussians:
    """Keep every k-th Gaussian, at most ``count``, but enlarged, so that they cover about the area of all Gaussians."""
    step = max(1, -(-len(gaussians) // count))
    sample = gaussians[::step]
    return replace(sample, scales=sample.scales * math.sqrt(step))
