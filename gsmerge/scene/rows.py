"""Take the Gaussians of a scene from the rows of a file, with their pixels, and read columns in other conventions."""

from __future__ import annotations

from dataclasses import replace
from math import prod

import numpy as np

from gsmerge.cameras import AlignmentResult
from gsmerge.geometry.transforms import camera_depths, rgb_to_sh0, sh0_to_rgb
from gsmerge.io.formats.color_units import ColorUnits
from gsmerge.io.formats.read import GaussianFile
from gsmerge.raster.photos import LEAST_OPACITY
from gsmerge.settings.reading import QuatChoice
from gsmerge.types import Gaussians, Pixels, Scene

_BLOCK = 1 << 20  # numbers that are compared at once


def take_gaussians(ply: GaussianFile, result: AlignmentResult) -> tuple[Gaussians, Pixels | None]:
    """Take the rows of a file that are visible Gaussians; sort them by their pixels, and return these, if known.

    If all Gaussians are too faint to be drawn, all valid rows are taken.
    """
    taken = ply.valid & (ply.gaussians.opacities >= LEAST_OPACITY)
    taken = taken if taken.any() else ply.valid
    grid, ids = (len(result.cameras), result.cameras.height, result.cameras.width), result.pixel_ids
    if ids is None or (len(ids) == prod(grid) and _counts_up(ids)):
        gaussians = ply.gaussians if taken.all() else ply.gaussians[taken]
        return gaussians, None if ids is None else Pixels.of_grid(taken.reshape(grid))
    rows = np.flatnonzero(taken)
    row_pixels = ids[rows]  # -1 for rows without a pixel
    is_sorted = _increases(row_pixels)  # each row has a pixel of its own, and rows are in the order of pixels
    if not is_sorted:
        order = np.argsort(row_pixels, kind="stable")
        rows, row_pixels = rows[order], row_pixels[order]
    gaussians = ply.gaussians if is_sorted and len(rows) == len(taken) else ply.gaussians[rows]
    if row_pixels[0] >= 0 and (is_sorted or _increases(row_pixels)):
        mask = np.zeros(prod(grid), bool)
        mask[row_pixels] = True
        return gaussians, Pixels.of_grid(mask.reshape(grid))
    # several Gaussians share a pixel, or some have none
    with_pixel = np.flatnonzero(row_pixels >= 0)
    points, views = gaussians.means[with_pixel].astype(np.float64), row_pixels[with_pixel] // prod(grid[1:])
    depths = camera_depths(points, result.cameras.viewmats, views)
    fronts = np.full(prod(grid), -1, np.int32)
    farthest_first = with_pixel[np.argsort(-depths, kind="stable")]
    fronts[row_pixels[farthest_first]] = farthest_first  # the nearest Gaussian of a pixel is written last
    return gaussians, Pixels(row_pixels, fronts.reshape(grid), own=True)


def _increases(ids: np.ndarray) -> bool:
    """Return whether each number is larger than the one before."""
    return bool((ids[1:] > ids[:-1]).all())


def _counts_up(ids: np.ndarray) -> bool:
    """Return whether numbers are 0, 1, 2, ...; many millions are compared block by block, which takes less memory."""
    blocks = ((first, ids[first : first + _BLOCK]) for first in range(0, len(ids), _BLOCK))
    return all(np.array_equal(block, np.arange(first, first + len(block), dtype=ids.dtype)) for first, block in blocks)


def read_as_harmonics(scene: Scene, units: ColorUnits) -> Scene:
    """Return a scene whose colours are harmonics, if its file was read as having RGB in ``units``."""
    stored = units.black + (units.white - units.black) * sh0_to_rgb(scene.gaussians.sh0)
    return replace(scene, gaussians=replace(scene.gaussians, sh0=stored.astype(np.float32)))


def read_as_rgb(scene: Scene, units: ColorUnits) -> Scene:
    """Return a scene whose colours are RGB in ``units``, if its file was read as having harmonics."""
    sh0 = rgb_to_sh0(units.rgb(scene.gaussians.sh0))
    return replace(scene, gaussians=replace(scene.gaussians, sh0=sh0.astype(np.float32)))


def read_rotations(scene: Scene, quats: QuatChoice) -> Scene:
    """Return a scene whose file was read as having quaternions wxyz, with those in the order ``quats`` of its file."""
    if quats == "wxyz":
        return scene
    return replace(scene, gaussians=replace(scene.gaussians, quats=np.roll(scene.gaussians.quats, 1, axis=1)))
