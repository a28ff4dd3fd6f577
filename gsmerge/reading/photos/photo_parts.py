"""Find which part of the photos the views show, if the photos have another shape than their cameras.

Photos may have bars, or show both eyes of a stereo camera or several pictures side by side. Bars are cut off, and one
of the pictures is used: the part by which photos best match the pictures of the Gaussians.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from gsmerge.errors import SceneError, attempt
from gsmerge.frozen import replace
from gsmerge.io.cameras.camera_file import CameraFile, sizes_of
from gsmerge.io.photo_files import (
    ASPECT_TOLERANCE,
    WHOLE,
    Part,
    Size,
    decode_image,
    image_size,
    limit_size,
    orientation_turn,
    part_size,
    resize_and_crop,
    resize_to,
    same_shape,
)
from gsmerge.method.compare.assign_photos import Assigner, Assignment, Candidates
from gsmerge.method.compare.offsets import OFFSET_PIXELS
from gsmerge.method.compare.view_pictures import show_views
from gsmerge.method.geometry.views import pick_views
from gsmerge.method.kernels.pictures import count_bars
from gsmerge.reading.photos.grid_fit import WHOLE_FIT, GridFit, PartFit, choose_fit
from gsmerge.reading.photos.scene_photos import ScenePhotos
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Scene

BAR_SPREAD = 8  # largest difference of the colours within a bar, of 255
_TILES = 4  # largest number of pictures in a row or a column of a photo
_HALVES: tuple[Part, ...] = ((0, 0, 0.5, 1), (0.5, 0, 1, 1), (0, 0, 1, 0.5), (0, 0.5, 1, 1))


def list_parts(size: Size, shape: Size | None, inner: Part) -> list[PartFit]:
    """List the parts of photos of a ``size`` that views may show, likely ones first.

    ``inner`` is the part of a photo without bars. Views have the aspect ratio of ``shape``. The whole photo and its
    halves are listed even if their aspect ratio differs from ``shape``; then they come last, and are stretched. If
    ``shape`` is None, views may have any aspect ratio, and no part is stretched.
    """
    counts = product(range(1, _TILES + 1), repeat=2)  # columns and lines of tiles
    tiles = [(x / m, y / n, (x + 1) / m, (y + 1) / n) for m, n in counts for y, x in product(range(n), range(m))]
    if shape is None:
        return [PartFit(part) for part in dict.fromkeys([WHOLE, inner, *tiles])]
    centre = resize_and_crop(size, shape)
    margins = centre.left / (centre.scale_x * size[0]), centre.top / (centre.scale_y * size[1])
    parts = dict.fromkeys([WHOLE, inner, *tiles, (*margins, 1 - margins[0], 1 - margins[1])])
    fits = [PartFit(part) for part in parts if same_shape(part_size(size, part), shape)]
    stretched = [part for part in (WHOLE, *_HALVES) if not same_shape(part_size(size, part), shape)]
    return [*fits, *(PartFit(part, shape) for part in stretched)]


def round_to_cameras(inner: Part, size: Size, shape: Size) -> Part:
    """Round the part ``inner`` of photos of a ``size`` to the size ``shape`` of the cameras, or to a multiple of it.

    ``inner`` is the part inside of bars. JPEG files mix the pixels of a block of 8 x 8, so the measured size of
    ``inner`` may be wrong by up to a block. The part is returned unchanged if rounding would change it by more than a
    block, or if the rounded part would not fit into the photos.
    """
    width, height = part_size(size, inner)
    times = max(1, round(width / shape[0]))
    sides = times * shape[0], times * shape[1]
    jpeg_block = 8  # pixels of a side of the blocks of a JPEG
    if (
        max(abs(width - sides[0]), abs(height - sides[1])) > jpeg_block
        or max(sides[0] / size[0], sides[1] / size[1]) > 1
    ):
        return inner
    left, top = (
        min(max(0, round((photo_side * (low + high) - side) / 2)), photo_side - side) / photo_side
        for photo_side, side, low, high in zip(size, sides, inner, inner[2:], strict=False)
    )
    return left, top, left + sides[0] / size[0], top + sides[1] / size[1]


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
        whole = attempt(decode_image, paths[number], size)
        if isinstance(whole, SceneError):
            return np.zeros((OFFSET_PIXELS, OFFSET_PIXELS, 3), np.float32), np.zeros(4)
        above, below, left, right = count_bars(whole, BAR_SPREAD)
        small = resize_to(size, limit_size(size, 4 * OFFSET_PIXELS)).photos([whole])[0]
        return small / np.float32(255), np.array([left, above, right, below]) / (size * 2)

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


def has_bars(images: np.ndarray | None) -> bool:
    """Return True if the first of the photos ``[v,h,w,3]`` has bars on opposite sides that change its shape."""
    if images is None:
        return False
    above, below, left, right = count_bars(images[0], BAR_SPREAD / 255)
    height, width = images.shape[1:3]
    is_letterbox = min(above, below) > 0 and above + below > ASPECT_TOLERANCE * height
    return is_letterbox or (min(left, right) > 0 and left + right > ASPECT_TOLERANCE * width)
