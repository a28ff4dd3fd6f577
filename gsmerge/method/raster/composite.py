"""Blend Gaussians along tile lists, apply the transpose of blending, and draw several views."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import ArrayLike

from gsmerge.arrays import Array as AnyArray
from gsmerge.arrays import ArrayFields, as_array
from gsmerge.frozen import dataclass
from gsmerge.method.kernels.raster import blend as kernels
from gsmerge.method.kernels.raster import project as projection
from gsmerge.method.raster.tiled_view import Array, Splats, TiledView, make_splats, pieces, tile_ranges
from gsmerge.runtime.threads import parallel_map, use_threads
from gsmerge.types import Cameras, Gaussians


def background_color(background: ArrayLike) -> Array:
    """Expand a background of one or three numbers to ``[3]``, or raise ValueError for other numbers."""
    try:
        return np.broadcast_to(np.asarray(background, np.float32), (3,)).copy()
    except (TypeError, ValueError):
        raise ValueError(f"expected a background of 1 or 3 numbers, got {background!r}") from None


def view_colors(tiled: TiledView) -> Array:
    """Return the colours ``[m,3]`` that a view's Gaussians show to its camera, clipped at 0."""
    colors = np.empty((len(tiled.ids), 3), np.float32)
    splats = tiled.splats
    with use_threads() as threads:
        parallel_map(
            lambda span: projection.view_colors(
                splats.means, splats.sh0, splats.shN, tiled.ids, tiled.eye, *span, colors
            ),
            pieces(len(tiled.ids), threads),
        )
    return colors


def blend(tiled: TiledView, colors: Array, background: Array) -> tuple[Array, Array]:
    """Blend the Gaussians of a view with ``colors [m,3]`` to an image ``[h,w,3]`` and a transmittance ``[h,w]``."""
    image = np.empty((tiled.height, tiled.width, 3), np.float32)
    transmittance = np.empty((tiled.height, tiled.width), np.float32)

    def blend_tiles(span: tuple[int, int]) -> None:
        """Blend a range of tiles."""
        kernels.blend(*tiled.lists, colors, *span, tiled.top, background, image, transmittance)

    with use_threads() as threads:
        parallel_map(blend_tiles, tile_ranges(tiled, threads))
    return image, transmittance


def depth_colors(tiled: TiledView, farthest: float = np.inf) -> Array:
    """Return the depths of the Gaussians of a view as colours ``[m,3]``, at most ``farthest``."""
    return np.repeat(np.minimum(tiled.depths, np.float32(farthest))[:, None], 3, 1)


def blend_depths(tiled: TiledView, farthest: float = np.inf) -> tuple[Array, Array]:
    """Return the mean depth ``[h,w]`` of the blended Gaussians of a view, and the transmittance ``[h,w]``.

    Gaussians that are farther away than ``farthest`` count with this depth.
    """
    blended, transmittance = blend(tiled, depth_colors(tiled, farthest), np.zeros(3, np.float32))
    min_opacity = 1e-6  # blended depths are divided by the opacity of their pixel, or by this if it is smaller
    return blended[..., 0] / np.maximum(1 - transmittance, np.float32(min_opacity)), transmittance


def find_covered(tiled: TiledView, limit: float) -> Array:
    """Return a mask ``[h,w]`` of the pixels of a view whose transmittance is at most ``limit``; it draws no more."""
    covered = np.empty((tiled.height, tiled.width), np.uint8)
    with use_threads() as threads:
        parallel_map(lambda span: kernels.cover(*tiled.lists, *span, limit, covered), tile_ranges(tiled, threads))
    return covered.view(bool)


def composite(tiled: TiledView, colors: Array | None = None, background: ArrayLike = 0.0) -> tuple[Array, Array]:
    """Blend the Gaussians of a view front to back into an image.

    ``colors [n,3]`` has the colour of every Gaussian, and may be negative. By default the spherical harmonics are
    evaluated for this view, and their colours are clipped at 0. ``background`` has 1 or 3 numbers. Returns the image
    ``[h,w,3]`` and the remaining transmittance ``[h,w]``, float32. Raises ValueError for other shapes.
    """
    if colors is None:
        return blend(tiled, view_colors(tiled), background_color(background))
    if colors.shape != (len(tiled.splats), 3):
        raise ValueError(f"colors: expected shape {[len(tiled.splats), 3]}, got {list(colors.shape)}")
    return blend(tiled, np.ascontiguousarray(colors.take(tiled.ids, 0), np.float32), background_color(background))


def splat_adjoint(tiled: TiledView, image: Array) -> Array:
    """Return, for each Gaussian, the sum ``[n,c]`` float32 of its blending weights times ``image [h,w,c]``.

    This map is the transpose of :func:`composite` (without background), which maps colours linearly to images. An image
    of four channels costs little more time than an image of one channel. Raises ValueError unless the image has the
    size of the view.
    """
    if image.ndim != 3 or image.shape[:2] != (tiled.height, tiled.width):
        raise ValueError(f"image: expected shape {[tiled.height, tiled.width, 'c']}, got {list(image.shape)}")
    sums = np.zeros((len(tiled.splats), image.shape[2]), np.float32)
    slots = np.empty((len(tiled.flatten_ids), kernels.CHANNELS), np.float32)

    def sum_tiles(span: tuple[int, int]) -> None:
        """For each tile of a range, write the sums over the tile to ``slots``."""
        kernels.weighted_sums(*tiled.lists, *span, channels, slots)

    with use_threads() as threads:
        for channel in range(0, image.shape[2], kernels.CHANNELS):
            channels = np.ascontiguousarray(image[..., channel : channel + kernels.CHANNELS], np.float32)
            parallel_map(sum_tiles, tile_ranges(tiled, threads))
            kernels.add_slots(tiled.flatten_ids, slots, tiled.ids, channel, sums)
    return sums


def survey(tiled: TiledView, colors: Array | None = None) -> tuple[Array, Array, Array]:
    """Draw a view over black, and measure the contributions of its Gaussians in the same pass.

    Returns the image ``[h,w,3]`` of :func:`composite`, and the sum ``[m]`` and the maximum ``[m]`` of the blending
    weights of each Gaussian of ``tiled.ids``. ``colors [n,3]`` are as in :func:`composite`.
    """
    own_colors = view_colors(tiled) if colors is None else np.ascontiguousarray(colors.take(tiled.ids, 0), np.float32)
    image = np.empty((tiled.height, tiled.width, 3), np.float32)
    totals = np.zeros((len(tiled.ids), 2), np.float32)
    kernels.survey(*tiled.lists, own_colors, image, totals)
    return image, totals[:, 0], totals[:, 1]


def contributions(tiled: TiledView) -> tuple[Array, Array]:
    """Return the sum ``[n]`` (pixels) and the maximum ``[n]`` of each Gaussian's blending weights, 0 if unseen."""
    mass, peak = np.zeros((2, len(tiled.splats)), np.float32)
    mass[tiled.ids], peak[tiled.ids] = list_contributions(tiled)
    return mass, peak


def list_contributions(tiled: TiledView) -> Array:
    """Return the sums and maxima ``[2,m]`` of :func:`contributions` for the Gaussians ``tiled.ids`` alone."""
    totals = np.zeros((len(tiled.ids), 2), np.float32)
    kernels.contributions(*tiled.lists, tiled.height, tiled.width, totals)
    return totals.T


@dataclass(frozen=True, eq=False, repr=False)
class Rendering(ArrayFields):
    """Rendered images of c views.

    Args:
        images: ``[c,h,w,3]`` float32 over the background, not clamped at 1.
        alphas: ``[c,h,w,1]`` float32, 1 less the remaining transmittance.
        depths: ``[c,h,w,1]`` float32 mean camera z of the blended Gaussians, 0 without any, or None if not requested.

    Example:
        >>> scene = gsmerge.read_scene("demo")
        >>> drawn = gsmerge.render(scene.gaussians, scene.cameras[[0]], with_depths=True)
        >>> drawn.images.shape, drawn.alphas.shape, drawn.depths.shape
        ((1, 32, 48, 3), (1, 32, 48, 1), (1, 32, 48, 1))
    """

    images: AnyArray
    alphas: AnyArray
    depths: AnyArray | None

    def __repr__(self) -> str:
        count, height, width = self.images.shape[:3]
        return f"Rendering({count} of {width} x {height}{'' if self.depths is None else ', depths'})"

    def _repr_png_(self) -> bytes | None:
        """Encode the first views, side by side, as the PNG that a notebook shows, or return None without views."""
        if len(self.images) == 0:
            return None
        notebook_views = 4  # number of a rendering's views that a notebook shows
        row = np.concatenate(list(as_array(self.images[:notebook_views])), 1)[..., ::-1]
        return cv2.imencode(".png", (row.clip(0, 1) * 255).round().astype(np.uint8))[1].tobytes()


def prepare_views(gaussians: Gaussians, cameras: Cameras) -> tuple[Splats, Array, Array]:
    """Return the Gaussians as splats, and the viewmats and the intrinsics of the cameras in float64.

    The origin of the splats is the cameras' mean centre. The origin is subtracted in float64, so that scenes in
    geographic coordinates keep their detail.
    """
    cameras = cameras.numpy()
    origin = cameras.centres.astype(np.float64).mean(0) if len(cameras) else np.zeros(3)
    return make_splats(gaussians, origin), cameras.viewmats.astype(np.float64), cameras.Ks.astype(np.float64)


def draw_views(
    tile_one: Callable[[int], TiledView],
    shape: tuple[int, int, int],
    background: AnyArray,
    with_depths: bool,
    first_view: int = 0,
) -> Rendering:
    """Draw the views from ``first_view`` on. ``shape`` is (number of views, height, width).

    ``tile_one(view)`` projects and tiles the Gaussians for one view.
    """
    images, alphas = np.empty((*shape, 3), np.float32), np.empty((*shape, 1), np.float32)
    depths = np.empty((*shape, 1), np.float32) if with_depths else None

    def draw_view(view: int) -> None:
        """Draw one view into the arrays of the result."""
        tiled = tile_one(first_view + view)
        images[view], transmittance = blend(tiled, view_colors(tiled), background)
        alphas[view, ..., 0] = 1 - transmittance
        if depths is not None:
            depths[view, ..., 0] = blend_depths(tiled)[0]

    parallel_map(draw_view, range(shape[0]))  # if there is a single view, its pieces use the pool
    return Rendering(images, alphas, depths)
