"""Find which part of the photos the views show, if the photos have another shape than their cameras.

Photos may have bars, or show both eyes of a stereo camera or several pictures side by side. Bars are cut off, and one
of the pictures is used: the part by which photos best match the pictures of the Gaussians. Photos that were cropped
after the model saw them show a part of their views, and are put in its place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from pathlib import Path

import cv2
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
    reaches_beyond,
    resize_and_crop,
    resize_to,
    same_shape,
)
from gsmerge.method.compare.assign_photos import Assigner, Assignment, Candidates
from gsmerge.method.compare.offsets import CONTRAST_PIXELS, OFFSET_PIXELS
from gsmerge.method.compare.similarity import find_contrast
from gsmerge.method.compare.view_pictures import ViewPictures, show_views
from gsmerge.method.geometry.views import pick_views
from gsmerge.method.kernels.pictures import count_bars
from gsmerge.method.raster.photos import shrink_pictures
from gsmerge.reading.photos.grid_fit import WHOLE_FIT, GridFit, PartFit, choose_fit, clear_beyond
from gsmerge.reading.photos.scene_photos import ScenePhotos
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Scene

POINT_SCALE = np.float32(0.1)  # by which Gaussians are multiplied that are drawn as points
BAR_SPREAD = 8  # largest difference of the colours within a bar, of 255
JPEG_BLOCK = 16  # pixels of a side of the blocks in which a JPEG mixes colours, of which it keeps every other one
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

    ``inner`` is the part inside of bars, whose measured size may be wrong by up to a block of a JPEG. The part is
    returned unchanged if rounding would change it by more, or if the rounded part would not fit into the photos.
    """
    width, height = part_size(size, inner)
    times = max(1, round(width / shape[0]))
    sides = times * shape[0], times * shape[1]
    if (
        max(abs(width - sides[0]), abs(height - sides[1])) > JPEG_BLOCK
        or max(sides[0] / size[0], sides[1] / size[1]) > 1
    ):
        return inner
    left, top = (
        min(max(0, round((photo_side * (low + high) - side) / 2)), photo_side - side) / photo_side
        for photo_side, side, low, high in zip(size, sides, inner, inner[2:], strict=False)
    )
    return left, top, left + sides[0] / size[0], top + sides[1] / size[1]


def find_crop(
    show: Callable[[int], ViewPictures], photos: Sequence[np.ndarray], size: Size, shape: Size, *, resized: bool
) -> PartFit:
    """Find where photos lie in their views that were all cropped in the same way after the model saw them.

    The contrast of photos is searched for in that of the views' pictures, at all places and scales at which photos lie
    inside their views: first in small pictures, then in larger ones near the scale that was found.

    Args:
        show: Function that makes pictures of the views with a number of pixels on the longer side.
        photos: Photos ``[h,w,3]`` of the views, which may be smaller than their files.
        size: Size of the files of the photos.
        shape: Size of the views.
        resized: Whether pixels of the photos may have another size than those of the views.
    """

    def place(views: Sequence[np.ndarray], spread: int, scale: float) -> tuple[float, float, float, float]:
        """Return the correlation at the best place of photos at a scale, the scale, and the place: column and line."""
        across, down = views[0].shape[1] / shape[0], views[0].shape[0] / shape[1]
        width, height = max(1, round(size[0] * scale * across)), max(1, round(size[1] * scale * down))
        scores = np.zeros(1)
        for view, photo in zip(views, photos, strict=True):
            small = find_contrast(shrink_pictures(photo[None], width, height)[0], None, spread)
            scores = scores + cv2.matchTemplate(view, small, cv2.TM_CCORR_NORMED)
        line, column = np.unravel_index(scores.argmax(), scores.shape)
        return float(scores.max()), scale, column / across, line / down

    largest = min(shape[0] / size[0], shape[1] / size[1])  # pixels of a view for a pixel of a photo
    scales = largest * (1 - 0.02 * np.arange(26)) if resized else np.ones(1)  # down to half of the largest
    scale = left = top = 0.0
    finest = min(max(shape), 2 * max(photos[0].shape))  # photos of half of their views have pixels as large as these
    for side, step in ((OFFSET_PIXELS // 4, 0.02), (OFFSET_PIXELS, 0.005), (finest, 0.001)):
        if step < 0.005 and scale == largest and same_shape(size, shape):  # photos show their whole views
            break
        shown = show(side)
        spread = CONTRAST_PIXELS * side // OFFSET_PIXELS
        views = [find_contrast(*view, spread) for view in zip(shown.pictures, shown.weights, strict=True)]
        _, scale, left, top = max(parallel_map(partial(place, views, spread), scales))
        if resized:
            near = scale * (1 + step / 4 * np.arange(-4, 5))
            scales = np.append(near[near < largest], largest) if near[-1] >= largest else near
    width, height = scale * size[0], scale * size[1]
    return PartFit((-left / width, -top / height, (shape[0] - left) / width, (shape[1] - top) / height))


def find_edge(lines: np.ndarray, width: int) -> int:
    """Find the edge of a bar of about ``width`` of the ``lines [n,m,3]`` of a photo.

    JPEG files mix the pixels of a block, so that a bar seems to end up to a block before its edge.
    """
    if width == 0:
        return 0
    near = lines[width - 1 : width + JPEG_BLOCK + 1].astype(np.float32)
    steps = np.abs(np.diff(near, axis=0)).mean((1, 2))
    return width + int((steps >= steps.max() / 2).argmax())  # steps within a bar are far smaller than its edge


def read_small(paths: Sequence[Path], sizes: Sequence[Size]) -> tuple[list[np.ndarray], Part]:
    """Read photos of ``sizes`` as small pictures, and find the part of a photo that is usually inside of bars.

    A damaged photo is black.
    """

    def read(number: int) -> tuple[np.ndarray, np.ndarray]:
        """Return a small photo, and the shares of its sides (left, above, right, below) that are bars."""
        size = sizes[number]
        whole = attempt(decode_image, paths[number], size)
        if isinstance(whole, SceneError):
            return np.zeros((OFFSET_PIXELS, OFFSET_PIXELS, 3), np.float32), np.zeros(4)
        above, below, left, right = count_bars(whole, BAR_SPREAD)
        columns = whole.swapaxes(0, 1)
        sides = (columns, left), (whole, above), (columns[::-1], right), (whole[::-1], below)
        widths = [find_edge(lines, width) for lines, width in sides]
        small = resize_to(size, limit_size(size, 4 * OFFSET_PIXELS)).photos([whole])[0]
        return small / np.float32(255), np.array(widths) / (size * 2)

    pictures, bars = zip(*parallel_map(read, range(len(paths))), strict=True)
    left, above, right, below = np.median(bars, 0).tolist()
    return list(pictures), (left, above, 1 - right, 1 - below)


def choose_part(
    scene: Scene,
    photos: ScenePhotos,
    camera_file: CameraFile,
    grid_fit: GridFit | None = None,
    *,
    explain_most: bool = False,
) -> ScenePhotos | None:
    """Find the part of the proposed photos that shows the views, and return photos of which this part is used.

    If parts of the views fit better than parts of the photos, photos are extended to their views, see
    :func:`find_crop`. None if no part fits better than whole photos, or if even the best part does not look like the
    views (:meth:`Assigner.explain_most`). None also if photos differ in shape or have orientation tags. ``grid_fit`` is
    how whole photos were resized, if the cameras were estimated. If whole photos ``explain_most`` views, they are
    compared with crops alone.
    """
    named = [(view, path) for view, path in enumerate(photos.named) if path is not None]
    max_compared = 8  # largest number of photos whose parts are compared with their views
    views, paths = zip(*(named[i] for i in pick_views(len(named), max_compared)), strict=True) if named else ((), ())
    sizes = [image_size(path) for path in paths]
    shapes_differ = not all(same_shape(size, sizes[0]) for size in sizes)
    if not paths or shapes_differ or any(map(orientation_turn, paths)):
        return None

    pictures, inner = read_small(paths, sizes)
    view_size = next(iter(sizes_of(camera_file)), (scene.cameras.width, scene.cameras.height))
    inner = inner if grid_fit else round_to_cameras(inner, sizes[0], view_size)
    fits: list[GridFit | PartFit] = [grid_fit or WHOLE_FIT] if grid_fit or explain_most else []
    if not explain_most:  # parts may have any shape if cameras were estimated
        fits += list_parts(sizes[0], None if grid_fit else view_size, inner)

    points = scene
    if not scene.has_own_pixels:  # Gaussians hide what is behind them, which moves slanted surfaces; points hardly do
        gaussians = scene.gaussians
        points = replace(scene, gaussians=replace(gaussians, scales=POINT_SCALE * gaussians.scales))

    def show(part: Part, side: int) -> ViewPictures:
        """Make pictures of the views, without what lies beyond a part of the photos."""
        shown = show_views(scene, side)[views]
        for weights in shown.weights:
            clear_beyond(weights, part)
        return shown

    def show_inside(part: Part, side: int) -> ViewPictures:
        """Make pictures of what a part of the photos shows of the views, cut to the photos."""
        shown = show(part, side)
        lines, columns = (np.flatnonzero(shown.weights.any((0, axis))) for axis in (2, 1))
        box = np.s_[:, lines[0] : lines[-1] + 1, columns[0] : columns[-1] + 1]
        return replace(shown, pictures=shown.pictures[box], weights=shown.weights[box])

    fit = choose_fit(show(WHOLE, OFFSET_PIXELS), pictures, fits)
    is_inside = max(np.divide(sizes[0], view_size)) <= 1 and 2 * math.prod(sizes[0]) >= math.prod(view_size)
    for resized in () if grid_fit else (False, True) if is_inside else (True,):  # resized crops have to fit better
        crop = find_crop(lambda side: show_views(points, side)[views], pictures, sizes[0], view_size, resized=resized)
        left, top, right, bottom = crop.part
        if (right - left) * (bottom - top) <= 2:  # photos of less than half of their views cannot be told from others
            fit = choose_fit(show(crop.part, OFFSET_PIXELS), pictures, [fit, crop])
    if isinstance(fit, GridFit) or fit == WHOLE_FIT:
        return None
    # photos that are extended are compared without what was added
    is_crop = reaches_beyond(fit.part)
    candidates = Candidates(
        lambda photo: pictures[photo] if is_crop else fit.cut(pictures[photo]), len(paths), lambda _: 0
    )
    assigner = Assigner(partial(show_inside if is_crop else show, fit.part), candidates)
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
