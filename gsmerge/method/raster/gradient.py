"""Compute the gradients of a loss on the image of a view with respect to its Gaussians.

:func:`gsmerge.render` uses the same kernels for its gradients. Results do not depend on the number of threads.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.method.kernels.matrices import matmul
from gsmerge.method.kernels.raster import project as projection
from gsmerge.method.kernels.raster.blend import blend_backward, gather_slots
from gsmerge.method.kernels.raster.project import BLOCK, POSE, SUMS, project_backward
from gsmerge.method.raster.tiled_view import Array, TiledView, pieces, tile_ranges
from gsmerge.runtime.threads import parallel_map, use_threads

# Least number of intersections or Gaussians per thread. The forward pass has a higher number, because it takes less
# time for each intersection or Gaussian than the backward pass
MIN_PER_THREAD = 1 << 12


@dataclass(frozen=True, eq=False)
class Gradients:
    """Gradients of a loss with respect to the Gaussians of a view."""

    ids: Array  # [m] int32 Gaussians of the rows, ascending; all other Gaussians have a gradient of zero
    means: Array  # [m,3] float32, through geometry only; ColorGradients has the part through the viewing direction
    quats: Array  # [m,4] float32, with respect to the quaternions as stored, which may have any length
    scales: Array  # [m,3] float32, with respect to linear scales
    opacities: Array  # [m] float32
    colors: Array  # [m,3] float32, with respect to the colours that are blended in this view
    viewmat: Array | None  # [4,4] float64, last row 0; None if not requested

    def __getitem__(self, rows: Array) -> Gradients:
        """Select the gradients of the Gaussians ``rows`` (mask or indices), and the gradient of the view matrix."""
        names = ("ids", "means", "quats", "scales", "opacities", "colors")
        return replace(self, **{name: np.ascontiguousarray(getattr(self, name)[rows]) for name in names})


@dataclass(frozen=True, eq=False)
class ColorGradients:
    """Gradients of a loss through the colours of the Gaussians of a view."""

    ids: Array  # [m] int32 Gaussians of the rows, ascending; all other Gaussians have a gradient of zero
    sh0: Array  # [m,1,3] float32
    shN: Array  # [m,k-1,3] float32
    means: Array  # [m,3] float32, through the viewing direction only


def gradients_of(
    tiled: TiledView,
    colors: Array,
    image: Array,
    transmittance: Array,
    grad_image: Array,
    grad_left: Array | None,
    with_viewmat: bool,
) -> Gradients:
    """Return the gradients of a loss on the image that :func:`gsmerge.method.raster.composite` made of a view.

    All arrays are float32 and contiguous. ``colors [m,3]`` are the colours of the view's Gaussians. ``image [h,w,3]``,
    with its background, and ``transmittance [h,w]`` are the results of ``composite``. ``grad_image [h,w,3]`` and
    ``grad_left [h,w]`` are the gradients of the loss with respect to the image and the transmittance. If ``grad_left``
    is None, the gradient with respect to the transmittance is zero. ``with_viewmat`` also asks for the gradient of the
    view matrix. The gradient of alpha is zero where alpha is clamped at 0.99. Thresholds that decide whether a Gaussian
    is drawn have no gradient.
    """
    m = len(tiled.ids)
    splats = tiled.splats
    slots = np.empty((len(tiled.flatten_ids), SUMS), np.float32)
    sums = np.zeros((m, SUMS), np.float32)
    means, quats, scales, color_sums = (np.empty((m, size), np.float32) for size in (3, 4, 3, 3))
    opacities = np.empty(m, np.float32)
    num_blocks = -(-m // BLOCK)
    poses = np.empty((num_blocks, POSE), np.float32) if with_viewmat else None

    def blend_tiles(span: tuple[int, int]) -> None:
        """For each tile of a range, write the sums of each Gaussian over the tile."""
        blend_backward(*tiled.lists, colors, *span, image, transmittance, grad_image, grad_left, slots)

    def project(span: tuple[int, int]) -> None:
        """Write the gradients of a range of Gaussians from their sums over all tiles."""
        gather_slots(tiled.flatten_ids, slots, *span, sums)
        project_backward(
            splats.means, splats.quats, splats.scales, tiled.opacities, tiled.ids, sums, tiled.camera, *span,
            means, quats, scales, opacities, poses,
        )  # fmt: skip
        color_sums[slice(*span)] = sums[slice(*span), :3]

    with use_threads() as threads:
        parallel_map(blend_tiles, tile_ranges(tiled, threads, MIN_PER_THREAD))
        # the range of each thread consists of whole blocks of the kernels
        num = max(1, min(threads, m // MIN_PER_THREAD))
        edges = [BLOCK * (num_blocks * i // num) for i in range(num)] + [m]
        parallel_map(project, pairwise(edges))
    viewmat = None if poses is None else viewmat_gradient(poses, splats.origin)
    return Gradients(
        tiled.ids, means=means, quats=quats, scales=scales, opacities=opacities, colors=color_sums, viewmat=viewmat
    )


def viewmat_gradient(poses: Array, origin: Array) -> Array:
    """Return the gradient ``[4,4]`` float64 of the view matrix in world coordinates.

    ``poses [blocks,POSE]`` are partial sums of :func:`project_backward`, whose coordinates begin at ``origin [3]``.
    """
    pose = poses.sum(0, dtype=np.float64)
    viewmat = np.zeros((4, 4))
    rotation = pose[:9].reshape(3, 3)
    shift = pose[9:]
    viewmat[:3, 3], viewmat[:3, :3] = shift, rotation + np.outer(shift, origin)
    return viewmat


def color_gradients(
    tiled: TiledView, grad_colors: Array, colors: Array, *, used: ColorGradients | None = None
) -> ColorGradients:
    """Return the gradients of a loss through the spherical harmonics of the Gaussians of a view.

    ``grad_colors [m,3]`` are :attr:`Gradients.colors`. No gradient passes where ``colors [m,3]``, which are float32,
    are clipped at 0. ``used`` is an earlier result that is no longer needed. The memory of ``used`` is reused if it has
    the same number of coefficients and enough rows, since new memory costs a quarter of the time or more.
    """
    m = len(tiled.ids)
    splats = tiled.splats
    shape_N = splats.shN.shape[1:]
    if used is not None and len(used.ids) >= m and used.shN.shape[1:] == shape_N:
        sh0 = used.sh0[:m]
        shN = used.shN[:m]
        means = used.means[:m]
    else:
        sh0, shN, means = (np.empty((m, *shape), np.float32) for shape in ((1, 3), shape_N, (3,)))
    with use_threads() as threads:
        parallel_map(
            lambda span: projection.view_colors_backward(
                splats.means, splats.shN, tiled.ids, tiled.eye, *span, colors, grad_colors, sh0, shN, means
            ),
            pieces(m, threads),
        )
    return ColorGradients(tiled.ids, sh0, shN, means)


def pose_gradient(tiled: TiledView, gradients: Gradients, color_grads: ColorGradients | None = None) -> Array:
    """Return the gradient ``[4,4]`` float64 of a loss with respect to the view matrix.

    The gradient passes through the geometry and, if ``color_grads`` are given, also through the colours.
    """
    assert gradients.viewmat is not None
    viewmat = gradients.viewmat.copy()
    if color_grads is not None:
        # The eye is -R^T t. Only the position of the eye relative to the means counts, so the gradient of the eye is
        # minus the sum of the gradients of all means
        eye = -color_grads.means.sum(0, dtype=np.float64)
        viewmat[:3, :3] -= np.outer(tiled.viewmat[:3, 3], eye)
        viewmat[:3, 3] -= matmul(tiled.viewmat[:3, :3], eye)
    return viewmat
