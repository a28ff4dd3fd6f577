"""Blending along a plan, its transpose, and images of several views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from gsmerge.kernels.raster import blend as kernels
from gsmerge.kernels.raster import sh
from gsmerge.raster.view_plan import Array, Splats, ViewPlan, pieces, prepare, tile_ranges
from gsmerge.runtime.threads import parallel_map, use_threads
from gsmerge.types import Array as AnyArray
from gsmerge.types import Cameras, Gaussians, as_array

SHOWN = 4  # views of a rendering that a notebook shows


def background_color(background: ArrayLike) -> Array:
    """Expand a background of one or three numbers to ``[3]``."""
    try:
        return np.broadcast_to(np.asarray(background, np.float32), (3,)).copy()
    except (TypeError, ValueError):
        raise ValueError(f"expected a background of 1 or 3 numbers, got {background!r}") from None


def view_colors(plan: ViewPlan) -> Array:
    """Evaluate the colours ``[m,3]`` of the plan's Gaussians as seen from its view, clipped at 0."""
    colors, splats = np.empty((len(plan.ids), 3), np.float32), plan.splats
    with use_threads() as threads:
        parallel_map(
            lambda span: sh.view_colors(splats.means, splats.sh0, splats.shN, plan.ids, plan.eye, *span, colors),
            pieces(len(plan.ids), threads),
        )
    return colors


def blend(plan: ViewPlan, colors: Array, background: Array) -> tuple[Array, Array]:
    """Blend ``colors [m,3]`` of the plan's Gaussians; return the image ``[h,w,3]`` and its transmittance ``[h,w]``."""
    image = np.empty((plan.height, plan.width, 3), np.float32)
    transmittance = np.empty((plan.height, plan.width), np.float32)

    def tiles(span: tuple[int, int]) -> None:
        kernels.blend(*plan.lists, colors, *span, plan.top, background, image, transmittance)

    with use_threads() as threads:
        parallel_map(tiles, tile_ranges(plan, threads))
    return image, transmittance


def mean_depths(plan: ViewPlan, alphas: Array) -> Array:
    """Return the mean blended depth ``[h,w]``, camera z; 0 where ``alphas [h,w]`` are 0."""
    weighted = blend(plan, np.repeat(plan.depths[:, None], 3, 1), np.zeros(3, np.float32))[0][..., 0]
    return np.divide(weighted, alphas, out=np.zeros_like(weighted), where=alphas > 0)


def composite(plan: ViewPlan, colors: Array | None = None, background: ArrayLike = 0.0) -> tuple[Array, Array]:
    """Blend the Gaussians of a view front to back into an image.

    ``colors [n,3]`` of all Gaussians may have any sign; None: their spherical harmonics seen from
    this view, not below 0. ``background``: 1 or 3 numbers. Returns the image ``[h,w,3]`` and the
    remaining transmittance ``[h,w]``, float32; raises ValueError for other shapes.
    """
    if colors is None:
        return blend(plan, view_colors(plan), background_color(background))
    if colors.shape != (len(plan.splats), 3):
        raise ValueError(f"colors: expected shape {[len(plan.splats), 3]}, got {list(colors.shape)}")
    return blend(plan, np.ascontiguousarray(colors.take(plan.ids, 0), np.float32), background_color(background))


def splat_adjoint(plan: ViewPlan, image: Array) -> Array:
    """Sum blending weight times ``image [h,w,c]`` over the pixels, for each Gaussian: ``[n,c]`` float32.

    This is the transpose of :func:`composite` (without background) as a linear map from colours to images. Four
    channels cost little more than one. Raises ValueError if the image has another size than the view.
    """
    if image.ndim != 3 or image.shape[:2] != (plan.height, plan.width):
        raise ValueError(f"image: expected shape {[plan.height, plan.width, 'c']}, got {list(image.shape)}")
    sums = np.zeros((len(plan.splats), image.shape[2]), np.float32)
    slots = np.empty((len(plan.flatten_ids), kernels.CHANNELS), np.float32)

    def tiles(span: tuple[int, int]) -> None:
        kernels.weighted_sums(*plan.lists, *span, part, slots)

    with use_threads() as threads:
        for first in range(0, image.shape[2], kernels.CHANNELS):
            part = np.ascontiguousarray(image[..., first : first + kernels.CHANNELS], np.float32)
            parallel_map(tiles, tile_ranges(plan, threads))
            kernels.add_slots(plan.flatten_ids, slots, plan.ids, first, sums)
    return sums


def survey(plan: ViewPlan, colors: Array | None = None) -> tuple[Array, Array, Array]:
    """Return the image of :func:`composite` over black, and sums and maxima of :func:`contributions`, ``[m]`` each."""
    drawn = view_colors(plan) if colors is None else np.ascontiguousarray(colors.take(plan.ids, 0), np.float32)
    image, totals = np.empty((plan.height, plan.width, 3), np.float32), np.zeros((len(plan.ids), 2), np.float32)
    kernels.survey(*plan.lists, drawn, image, totals)
    return image, totals[:, 0], totals[:, 1]


def contributions(plan: ViewPlan) -> tuple[Array, Array]:
    """Return the sum (pixels) and the maximum of each Gaussian's blending weights, ``[n]`` float32; 0 if unseen."""
    totals = np.zeros((len(plan.ids), 2), np.float32)
    kernels.contributions(*plan.lists, plan.height, plan.width, totals)
    mass, peak = np.zeros((2, len(plan.splats)), np.float32)
    mass[plan.ids], peak[plan.ids] = totals.T
    return mass, peak


@dataclass(frozen=True, eq=False)
class Rendering:
    """Rendered images of c views.

    Args:
        images: ``[c,h,w,3]`` float32 over the background, not clamped at 1.
        alphas: ``[c,h,w,1]`` float32, 1 less the remaining transmittance.
        depths: ``[c,h,w,1]`` float32 mean camera z of what was blended, 0 where nothing was; None if not asked for.

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
        """Encode the first views, side by side, as the picture that a notebook shows."""
        if len(self.images) == 0:
            return None
        row = np.concatenate(list(as_array(self.images[:SHOWN])), 1)[..., ::-1]
        return cv2.imencode(".png", (row.clip(0, 1) * 255).round().astype(np.uint8))[1].tobytes()


def prepare_views(gaussians: Gaussians, cameras: Cameras) -> tuple[Splats, Array, Array]:
    """Return splats relative to the cameras' mean centre, and viewmats and intrinsics in float64.

    The centre is subtracted in float64, so that scenes in geographic coordinates keep their detail.
    """
    cameras = cameras.numpy()
    origin = cameras.centres.astype(np.float64).mean(0) if len(cameras) else np.zeros(3)
    return prepare(gaussians, origin), cameras.viewmats.astype(np.float64), cameras.Ks.astype(np.float64)


def draw_views(
    plan_one: Callable[[int], ViewPlan],
    shape: tuple[int, int, int],
    background: AnyArray,
    with_depths: bool,
    first: int = 0,
) -> Rendering:
    """Draw the plans of all views; ``shape`` is (views, height, width).

    View numbers start at ``first``.
    """
    images, alphas = np.empty((*shape, 3), np.float32), np.empty((*shape, 1), np.float32)
    depths = np.empty((*shape, 1), np.float32) if with_depths else None

    def one(view: int) -> None:
        plan = plan_one(first + view)
        images[view], transmittance = blend(plan, view_colors(plan), background)
        alphas[view, ..., 0] = 1 - transmittance
        if depths is not None:
            depths[view, ..., 0] = mean_depths(plan, alphas[view, ..., 0])

    parallel_map(one, range(shape[0]))  # of one view alone, the pieces share the pool
    return Rendering(images, alphas, depths)
