"""Rows of a file -> Gaussians of a scene, in the order of their pixels: places, colours, depths, rotations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsmerge.alignment import AlignmentResult, Layout, choose_rotations, read_rotations
from gsmerge.errors import SceneError
from gsmerge.geometry import Similarity, rgb_to_sh0
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.cameras.read import holds_images, read_depths
from gsmerge.io.formats.read import GaussianFile
from gsmerge.io.formats.table import DEPTHS, find_format
from gsmerge.scene.exporters import TURNED, Exporter, ReadHints
from gsmerge.scene.files import SceneFiles
from gsmerge.types import Gaussians, Scene, grid_ids

_PART = 1 << 20  # numbers that are compared at once


def color_from_photos(gaussians: Gaussians, images: np.ndarray, files: SceneFiles) -> Gaussians:
    """Give Gaussians of depth maps without images the colours of the photos.

    Other Gaussians stay unchanged. SceneError without photos.
    """
    if find_format(files.ply) is not DEPTHS or holds_images(files.ply):
        return gaussians
    if images.size != 3 * len(gaussians):
        problem = "expected images with the depth maps, found none, and no photos of their views"
        raise SceneError(files.ply, problem, "name their folder with --images")
    return replace(gaussians, sh0=rgb_to_sh0(images.reshape(-1, 1, 3)))


def use_depths(scene: Scene, camera_file: CameraFile, layout: Layout, unit: float) -> tuple[Scene, list[str]]:
    """Start from depth maps beside the file where they are better, or where the exporter dropped pixels; with notes.

    ``unit``: that of the cameras' file in the scene's.
    """
    depths = read_depths(Path(camera_file.path)) if layout.per_pixel == 1 else None
    if depths is None or depths.shape[1:] != scene.valid.shape[1:] or len(depths) <= max(layout.views):
        return scene, []
    depths = depths[list(layout.views)]
    from gsmerge.alignment import choose_depths, fill_from_depths

    scene, moved = choose_depths(scene, depths, unit)
    notes = [f"{moved:,} Gaussians start at the depth maps, which other views confirm more often"] * (moved > 0)
    if scene.images is None or scene.missing is None or layout.kind != "box+depth":
        return scene, notes
    full = fill_from_depths(scene, depths, scene.images)
    count = int(full.valid.sum()) - int(scene.valid.sum())
    filled = f"{count:,} pixels that the exporter dropped are put back from the depth maps"
    return full, [*notes, *[filled] * (count > 0)]


def sort_rows(
    ply: GaussianFile, result: AlignmentResult
) -> tuple[Gaussians, np.ndarray | None, np.ndarray | None, list[str]]:
    """Sort rows by the pixels of the grid; return Gaussians, ``pixel_ids``, ``missing`` and notes.

    Pixels without a row get a fully transparent Gaussian. Rows without pixels are kept if they are finite and not
    padding.
    """
    if result.pixel_ids is None:
        from gsmerge.alignment import find_padding

        gaussians = ply.gaussians
        keep = ply.valid & ~find_padding(gaussians)
        count = int(ply.valid.sum()) - int(keep.sum())
        notes = [f"{count:,} Gaussians that only fill the file up are left out"] if count else []
        return ply.gaussians[keep], None, None, notes
    grid = len(result.views), result.cameras.height, result.cameras.width
    size, ids = int(np.prod(grid)), result.pixel_ids
    if len(ids) == size and _counts_up(ids):
        return ply.gaussians, grid_ids(ply.valid), None, []
    source = np.full(size, -1, np.int64)
    rows = np.flatnonzero(ids >= 0)
    source[ids[rows]] = rows
    missing = source < 0
    if not missing.any():
        return ply.gaussians[source], grid_ids(ply.valid[source]), None, []
    before = np.maximum.accumulate(np.where(missing, np.argmin(missing), np.arange(size)))
    out = ply.gaussians[source[before]]
    valid = ply.valid[source[before]] & ~missing
    for values in (out.opacities, out.sh0, out.shN):
        values[missing] = 0
    out.quats[missing] = (1, 0, 0, 0)
    return out, grid_ids(valid), missing.reshape(grid), []


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
