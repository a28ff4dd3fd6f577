"""Take the Gaussians of a scene and their pixels from the rows of a file, and read columns in other conventions."""

from __future__ import annotations

from dataclasses import replace
from math import prod

import numpy as np

from gsmerge.errors import Note, split_notes
from gsmerge.io.formats.read_gaussians import GaussianFile
from gsmerge.io.formats.units import RGB_NOTE
from gsmerge.method.compare.colors import cut_blocks
from gsmerge.method.compare.offsets import OFFSET_PIXELS
from gsmerge.method.compare.similarity import stands_out
from gsmerge.method.compare.view_pictures import Pairs, show_views
from gsmerge.method.geometry.transforms import camera_depths, rgb_to_sh0, sh0_to_rgb
from gsmerge.method.raster.photos import LEAST_OPACITY, shrink_pictures
from gsmerge.reading.alignment import AlignmentResult
from gsmerge.reading.loaded import Loaded
from gsmerge.types import Gaussians, Pixels

_BLOCK = 1 << 20  # numbers that are compared at once


def take_gaussians(ply: GaussianFile, result: AlignmentResult) -> tuple[Gaussians, Pixels | None]:
    """Return the visible Gaussians of a file, sorted by their pixels, and these pixels; None for unknown pixels.

    If all Gaussians are too faint to be drawn, the Gaussians of all valid rows are returned.
    """
    is_visible = ply.valid & (ply.gaussians.opacities >= LEAST_OPACITY)
    taken = is_visible if is_visible.any() else ply.valid
    grid = (len(result.cameras), result.cameras.height, result.cameras.width)
    pixel_ids = result.pixel_ids
    # rows without pixels, or all pixels in order
    if pixel_ids is None or (len(pixel_ids) == prod(grid) and _counts_up(pixel_ids)):
        gaussians = ply.gaussians if taken.all() else ply.gaussians[taken]
        return gaussians, None if pixel_ids is None else Pixels.of_grid(taken.reshape(grid))
    rows = np.flatnonzero(taken)
    row_pixels = pixel_ids[rows]  # -1 for rows without a pixel
    is_sorted = _increases(row_pixels)
    if not is_sorted:
        order = np.argsort(row_pixels, kind="stable")
        rows = rows[order]
        row_pixels = row_pixels[order]
    gaussians = ply.gaussians if is_sorted and len(rows) == len(taken) else ply.gaussians[rows]
    # each row has a different pixel
    if row_pixels[0] >= 0 and (is_sorted or _increases(row_pixels)):
        has_row = np.zeros(prod(grid), bool)
        has_row[row_pixels] = True
        return gaussians, Pixels.of_grid(has_row.reshape(grid))
    # several Gaussians share a pixel, or some have no pixel
    with_pixel = np.flatnonzero(row_pixels >= 0)
    points = gaussians.means[with_pixel].astype(np.float64)
    views = row_pixels[with_pixel] // prod(grid[1:])
    depths = camera_depths(points, result.cameras.viewmats, views)
    fronts = np.full(prod(grid), -1, np.int32)
    farthest_first = with_pixel[np.argsort(-depths, kind="stable")]
    fronts[row_pixels[farthest_first]] = farthest_first  # the nearest Gaussian of a pixel is written last
    return gaussians, Pixels(row_pixels, fronts.reshape(grid), own=True)


def _increases(ids: np.ndarray) -> bool:
    """Return whether each number is larger than the number before."""
    return bool((ids[1:] > ids[:-1]).all())


def _counts_up(ids: np.ndarray) -> bool:
    """Return whether numbers are 0, 1, 2, ...; the comparison goes block by block, which takes less memory."""
    blocks = ((first, ids[first : first + _BLOCK]) for first in range(0, len(ids), _BLOCK))
    return all(np.array_equal(block, np.arange(first, first + len(block), dtype=ids.dtype)) for first, block in blocks)


def confirm_colors(load: Loaded) -> Loaded:
    """Read colours as RGB or its logits instead of harmonics, or RGB as harmonics, if photos fit that better."""
    old_info = load.info
    units = load.info.open_units
    images = load.scene.images
    if units is None or images is None:
        return load
    was_rgb = old_info.color_units is not None  # the colours were read as RGB, and harmonics are tried here
    sh0 = load.scene.gaussians.sh0
    sh0 = units.stored(sh0_to_rgb(sh0)) if was_rgb else rgb_to_sh0(units.rgb(sh0))
    other = replace(load.scene, gaussians=replace(load.scene.gaussians, sh0=sh0.astype(np.float32)))
    errors = []  # of blocks of both scenes' pictures, against the same blocks of the photos
    for scene in (load.scene, other):
        shown = show_views(scene, OFFSET_PIXELS)
        photos = shrink_pictures(images, *shown.weights.shape[2:0:-1])
        errors.append(cut_blocks(Pairs(photos, shown)).errors())
    if not stands_out(errors[0] - errors[1]):
        return load
    new_note = "" if was_rgb else RGB_NOTE.format(units.name, "photos show it")
    notes = *([Note(new_note, "colors")] if new_note else []), *split_notes(load.notes, "colors")[1]
    info = replace(old_info, color_units=None if was_rgb else units, color_note=new_note)
    return replace(load, scene=other, info=info, notes=notes)
