"""Photos that have another shape than their views, or show more -> the part of each photo that shows its view.

Bars are cut off. If photos show both eyes of a stereo camera, or several pictures side by side, one of the pictures is
used.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry.views import pick_views
from gsmerge.io.cameras.camera_file import CameraFile, sizes_of
from gsmerge.io.photo_files import WHOLE, decode_image, image_size, limit_size, orientation_turn, resize_to, same_shape
from gsmerge.kernels.pictures import count_bars
from gsmerge.reading.photos.assign_photos import Assigner, Assignment, Candidates
from gsmerge.reading.photos.grid_fit import (
    BAR_SPREAD,
    WHOLE_FIT,
    GridFit,
    PartFit,
    choose_fit,
    list_parts,
    round_to_cameras,
)
from gsmerge.reading.photos.offsets import OFFSET_PIXELS
from gsmerge.reading.photos.scene_photos import ScenePhotos
from gsmerge.reading.photos.view_pictures import show_views
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Scene


def choose_part(
    scene: Scene, photos: ScenePhotos, camera_file: CameraFile, grid_fit: GridFit | None = None
) -> ScenePhotos | None:
    """Find the part of the proposed photos that shows the views, and return photos of which this part is used.

    None if no part fits better than whole photos, or if even the best part does not look like the views
    (:meth:`Assigner.explain_most`). None also if photos differ in shape or have orientation tags. ``grid_fit`` is how
    whole photos were resized, if the cameras were estimated.
    """
    named = [(view, path) for view, path in enumerate(photos.named) if path is not None]
    max_compared = 8  # largest number of photos whose parts are compared with their views
    views, paths = zip(*(named[i] for i in pick_views(len(named), max_compared)), strict=True) if named else ((), ())
    sizes = [image_size(path) for path in paths]
    shapes_differ = not all(same_shape(size, sizes[0]) for size in sizes)
    if not paths or shapes_differ or any(map(orientation_turn, paths)):
        return None

    def read(number: int) -> tuple[np.ndarray, np.ndarray]:
        """Return a small photo, and the shares of its sides (left, above, right, below) that are bars."""
        size = sizes[number]
        with suppress(SceneError):
            whole = decode_image(paths[number], size)
            above, below, left, right = count_bars(whole, BAR_SPREAD)
            small = resize_to(size, limit_size(size, 4 * OFFSET_PIXELS)).photos([whole])[0]
            return small / np.float32(255), np.array([left, above, right, below]) / (size * 2)
        return np.zeros((OFFSET_PIXELS, OFFSET_PIXELS, 3), np.float32), np.zeros(4)

    pictures, bars = zip(*parallel_map(read, range(len(paths))), strict=True)
    left, above, right, below = np.median(bars, 0).tolist()
    inner = left, above, 1 - right, 1 - below  # the part inside of bars
    view_size = next(iter(sizes_of(camera_file)), (scene.cameras.width, scene.cameras.height))
    if grid_fit is None:
        inner = round_to_cameras(inner, sizes[0], view_size)
        fits: list[GridFit | PartFit] = [*list_parts(sizes[0], view_size, inner)]
    else:  # cameras were estimated, so parts may have any shape
        fits = [grid_fit, *list_parts(sizes[0], None, inner)]
    fit = choose_fit(show_views(scene, OFFSET_PIXELS)[views], pictures, fits)
    if isinstance(fit, GridFit) or fit == WHOLE_FIT:
        return None
    candidates = Candidates(read=lambda photo: fit.cut(pictures[photo]), count=len(paths), tag=lambda _: 0)
    assigner = Assigner(lambda side: show_views(scene, side)[views], candidates)
    is_right = assigner.explain_most([Assignment(photo, 0) for photo in range(len(paths))])
    note = fit.describe(sizes[0], bars=fit.part == inner != WHOLE)
    return replace(photos, fit=fit, notes=(*photos.notes, note)) if is_right else None
