"""Make the Gaussians of a scene from the rows of a file: their pixels and rotations."""

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
    """Take the rows of a file that are visible Gaussians, in the order of their pixels if known.

    If all are too faint to be drawn, all valid rows are taken.
    """
    taken = ply.valid & (ply.gaussians.opacities >= LEAST_OPACITY)
    taken = taken if taken.any() else ply.valid
    grid, ids = (len(result.cameras), result.cameras.height, result.cameras.width), result.pixel_ids
    if ids is None or (len(ids) == prod(grid) and _counts_up(ids)):
        gaussians = ply.gaussians if taken.all() else ply.gaussians[taken]
        return gaussians, None if ids is None else Pixels.of_grid(taken.reshape(grid))
    rows = np.flatnonzero(taken)
    homes = ids[rows]
    are_alone = _increases(homes)  # each row has a pixel of its own, and rows are in the order of pixels
    if not are_alone:
        order = np.argsort(homes, kind="stable")
        rows, homes = rows[order], homes[order]
    gaussians = ply.gaussians if are_alone and len(rows) == len(taken) else ply.gaussians[rows]
    if homes[0] >= 0 and (are_alone or _increases(homes)):
        mask = np.zeros(prod(grid), bool)
        mask[homes] = True
        return gaussians, Pixels.of_grid(mask.reshape(grid))
    in_pixels = np.flatnonzero(homes >= 0)  # several Gaussians share a pixel, or some have none
    points, views = gaussians.means[in_pixels].astype(np.float64), homes[in_pixels] // prod(grid[1:])
    depths = camera_depths(points, result.cameras.viewmats, views)
    fronts = np.full(prod(grid), -1, np.int32)
    farthest_first = in_pixels[np.argsort(-depths, kind="stable")]
    fronts[homes[farthest_first]] = farthest_first  # the nearest Gaussian of a pixel is written last
    return gaussians, Pixels(homes, fronts.reshape(grid), own=True)


def _increases(ids: np.ndarray) -> bool:
    """Return whether each number is larger than the one before."""
    return bool((ids[1:] > ids[:-1]).all())


def _counts_up(ids: np.ndarray) -> bool:
    """Return whether numbers are 0, 1, 2, ...; they are compared block by block, since there may be many millions."""
    blocks = ((first, ids[first : first + _BLOCK]) for first in range(0, len(ids), _BLOCK))
    return all(np.array_equal(block, np.arange(first, first + len(block), dtype=ids.dtype)) for first, block in blocks)


def read_as_harmonics(scene: Scene, units: ColorUnits) -> Scene:
    """Return a scene whose colours, which were read as RGB in ``units``, are read as harmonics."""
    stored = units.black + (units.white - units.black) * sh0_to_rgb(scene.gaussians.sh0)
    return replace(scene, gaussians=replace(scene.gaussians, sh0=stored.astype(np.float32)))


def read_as_rgb(scene: Scene, units: ColorUnits) -> Scene:
    """Return a scene whose colours, which were read as harmonics, are read as RGB in ``units``."""
    sh0 = rgb_to_sh0(units.rgb(scene.gaussians.sh0))
    return replace(scene, gaussians=replace(scene.gaussians, sh0=sh0.astype(np.float32)))


def read_rotations(scene: Scene, quats: QuatChoice) -> Scene:
    """Return a scene whose rotations, which were read as wxyz, are in the order that a hint says."""
    if quats == "wxyz":
        return scene
    return replace(scene, gaussians=replace(scene.gaussians, quats=np.roll(scene.gaussians.quats, 1, axis=1)))
