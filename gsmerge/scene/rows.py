"""Rows of a file -> Gaussians of a scene, in the order of their pixels: places, colours, depths, rotations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import prod
from pathlib import Path

import numpy as np

from gsmerge.alignment import AlignmentResult, Layout, choose_rotations, read_rotations
from gsmerge.errors import SceneError
from gsmerge.geometry import Similarity, camera_depths, rgb_to_sh0
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.cameras.read import holds_images, read_depths
from gsmerge.io.formats.read import GaussianFile
from gsmerge.io.formats.table import DEPTHS, find_format
from gsmerge.raster.photos import LEAST_OPACITY
from gsmerge.scene.exporters import TURNED, Exporter, ReadHints
from gsmerge.scene.files import SceneFiles
from gsmerge.types import Gaussians, Pixels, Scene

_PART = 1 << 20  # numbers that are compared at once


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


def use_depths(scene: Scene, camera_file: CameraFile, layout: Layout, unit: float) -> tuple[Scene, list[str]]:
    """Start from depth maps beside the file where they are better, or where the exporter dropped pixels; with notes.

    ``unit``: that of the cameras' file in the scene's.
    """
    depths = read_depths(Path(camera_file.path)) if layout.per_pixel == 1 else None
    size = scene.cameras.height, scene.cameras.width
    if depths is None or depths.shape[1:] != size or len(depths) <= max(layout.views):
        return scene, []
    depths = depths[list(layout.views)]
    from gsmerge.alignment import choose_depths, fill_from_depths

    scene, moved = choose_depths(scene, depths, unit)
    notes = [f"{moved:,} Gaussians start at the depth maps, which other views confirm more often"] * (moved > 0)
    if scene.images is None or layout.kind not in ("box+depth", "pruned"):
        return scene, notes
    full = fill_from_depths(scene, depths, scene.images)
    count = len(full.gaussians) - len(scene.gaussians)
    filled = f"{count:,} pixels that the exporter dropped are put back from the depth maps"
    return full, [*notes, *[filled] * (count > 0)]


def take_gaussians(ply: GaussianFile, result: AlignmentResult) -> tuple[Gaussians, Pixels | None]:
    """Take the rows of a file that are Gaussians and that something draws, in the order of their pixels if known.

    If nothing draws any, all rows that are Gaussians are taken.
    """
    there = ply.valid & (ply.gaussians.opacities >= LEAST_OPACITY)
    there = there if there.any() else ply.valid
    grid, ids = (len(result.views), result.cameras.height, result.cameras.width), result.pixel_ids
    if ids is None or (len(ids) == prod(grid) and _counts_up(ids)):
        gaussians = ply.gaussians if there.all() else ply.gaussians[there]
        return gaussians, None if ids is None else Pixels.of_grid(there.reshape(grid))
    rows = np.flatnonzero(there)
    rows = rows[np.argsort(ids[rows], kind="stable")]
    homes, gaussians = ids[rows], ply.gaussians[rows]
    if len(np.unique(homes)) == len(homes) and homes[0] >= 0:
        mask = np.zeros(prod(grid), bool)
        mask[homes] = True
        return gaussians, Pixels.of_grid(mask.reshape(grid))
    seen = np.flatnonzero(homes >= 0)
    viewmats = result.cameras.viewmats[list(result.views)]
    depths = camera_depths(gaussians.means[seen].astype(np.float64), viewmats[homes[seen] // prod(grid[1:])])
    fronts = np.full(prod(grid), -1, np.int32)
    farthest_first = seen[np.argsort(-depths, kind="stable")]
    fronts[homes[farthest_first]] = farthest_first
    return gaussians, Pixels(homes, fronts.reshape(grid), own=True)


def _counts_up(ids: np.ndarray) -> bool:
    """Return whether numbers are 0, 1, 2, ...; compared in parts, as there may be hundreds of millions."""
    starts = range(0, len(ids), _PART)
    parts = ((first, ids[first : first + _PART]) for first in starts)
    return all(np.array_equal(part, np.arange(first, first + len(part), dtype=ids.dtype)) for first, part in parts)


def set_rotations(
    scene: Scene, hints: ReadHints, exporters: Sequence[Exporter], frame: Similarity
) -> tuple[Scene, list[str]]:
    """Read rotations by the hint, as the given exporter stores them, or as fits the surface; with a note."""
    turn = frame.rotation if frame.kind in TURNED else None
    if hints.quats != "auto":
        return read_rotations(scene, hints.quats, turn), []
    if hints.exporter != "auto":
        return read_rotations(scene, exporters[0].quats, turn), []
    if any(not exporter.check_rotations for exporter in exporters):
        return scene, []
    choice, note = choose_rotations(scene, turn)
    return read_rotations(scene, choice, turn), [note] if note else []
