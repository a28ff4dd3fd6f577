"""Make the Gaussians of a scene from the rows of a file: their pixels, colours, depths and rotations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import prod

import numpy as np

from gsmerge.alignment import AlignmentResult, Layout, choose_rotations, read_rotations
from gsmerge.errors import SceneError
from gsmerge.geometry import Similarity, camera_depths, rgb_to_sh0
from gsmerge.io.cameras.read import holds_images
from gsmerge.io.formats.read import GaussianFile
from gsmerge.io.formats.table import DEPTHS, find_format
from gsmerge.raster.photos import LEAST_OPACITY
from gsmerge.scene.exporters import TURNED, Exporter, ReadHints
from gsmerge.scene.files import SceneFiles
from gsmerge.types import Gaussians, Pixels, Scene

_BLOCK = 1 << 20  # numbers that are compared at once


def color_from_photos(gaussians: Gaussians, pixels: Pixels | None, images: np.ndarray, files: SceneFiles) -> Gaussians:
    """Give Gaussians of depth maps without images the colours of the photos.

    Other Gaussians stay unchanged. SceneError without photos.
    """
    if find_format(files.ply) is not DEPTHS or holds_images(files.ply):
        return gaussians
    if pixels is None or not len(images):
        problem = "expected images with the depth maps, found none, and no photos of their views"
        raise SceneError(files.ply, problem, "name their folder with --images")
    return replace(gaussians, sh0=rgb_to_sh0(images.reshape(-1, 1, 3)[pixels.homes]))


def use_depths(
    scene: Scene, read_depths: Callable[[], np.ndarray | None], layout: Layout, unit: float
) -> tuple[Scene, list[str]]:
    """Move Gaussians to the depth maps beside the file if these fit better, and put back pixels that it lacks.

    ``unit``: length of one unit of the cameras' file in the scene's units. Also returns notes.
    """
    depths = read_depths() if layout.per_pixel == 1 else None
    size = scene.cameras.height, scene.cameras.width
    if depths is None or depths.shape[1:] != size or len(depths) <= max(layout.views):
        return scene, []
    depths = depths[list(layout.views)]
    from gsmerge.alignment import choose_depths, fill_from_depths

    scene, moved = choose_depths(scene, depths, unit)
    notes = [f"{moved:,} Gaussians start at the depth maps, which other views confirm more often"] if moved else []
    if scene.images is None or layout.kind not in ("box+depth", "pruned"):
        return scene, notes
    full = fill_from_depths(scene, depths, scene.images)
    count = len(full.gaussians) - len(scene.gaussians)
    added = f"{count:,} pixels that the exporter dropped are put back from the depth maps"
    return full, [*notes, *([added] if count > 0 else [])]


def take_gaussians(ply: GaussianFile, result: AlignmentResult) -> tuple[Gaussians, Pixels | None]:
    """Take the rows of a file that are visible Gaussians, in the order of their pixels if known.

    If all are too faint to be drawn, all valid rows are taken.
    """
    taken = ply.valid & (ply.gaussians.opacities >= LEAST_OPACITY)
    taken = taken if taken.any() else ply.valid
    grid, ids = (len(result.views), result.cameras.height, result.cameras.width), result.pixel_ids
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
    viewmats = result.cameras.viewmats[list(result.views)]
    depths = camera_depths(gaussians.means[in_pixels].astype(np.float64), viewmats, homes[in_pixels] // prod(grid[1:]))
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


def set_rotations(
    scene: Scene, hints: ReadHints, exporters: Sequence[Exporter], frame: Similarity
) -> tuple[Scene, list[str]]:
    """Convert rotations as the hint says, as the named exporter stores them, or so that they fit the surface.

    Also returns a note if the fit to the surface changed them.
    """
    turn = frame.rotation if frame.kind in TURNED else None
    if hints.quats != "auto":
        return read_rotations(scene, hints.quats, turn), []
    if hints.exporter != "auto":
        return read_rotations(scene, exporters[0].quats, turn), []
    if any(not exporter.check_rotations for exporter in exporters):
        return scene, []
    choice, note = choose_rotations(scene, turn)
    return read_rotations(scene, choice, turn), [note] if note else []
