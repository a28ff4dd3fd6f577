"""Find which part of the photos the views show, and how photos were resized to the grid of a file's rows.

Photos of another shape than their cameras may have bars, or show both eyes of a stereo camera or several pictures side
by side. Bars are cut off, and one of the pictures is used. If a file has no cameras, its model may have cropped the
photos or changed their aspect ratio, and may have cut borders off its output. The choice of part and resizing is the
one by which photos best match the pictures of the Gaussians.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from gsmerge.errors import SceneError, attempt
from gsmerge.frozen import dataclass, replace
from gsmerge.geometry.views import pick_views
from gsmerge.io.cameras.camera_file import CameraFile, sizes_of
from gsmerge.io.photo_files import (
    ASPECT_TOLERANCE,
    WHOLE,
    Part,
    PhotoTransform,
    Size,
    cut_part,
    decode_image,
    image_size,
    limit_size,
    orientation_turn,
    part_size,
    resize_and_crop,
    resize_to,
    same_shape,
)
from gsmerge.kernels.pictures import count_bars
from gsmerge.reading.alignment import TRIMS
from gsmerge.reading.photos.assign_photos import Assigner, Assignment, Candidates
from gsmerge.reading.photos.offsets import OFFSET_PIXELS, correlate_parts
from gsmerge.reading.photos.similarity import stands_out
from gsmerge.reading.photos.view_pictures import ViewPictures, show_views
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Scene

if TYPE_CHECKING:
    from gsmerge.reading.photos.scene_photos import ScenePhotos

BAR_SPREAD = 8  # largest difference of the colours within a bar, of 255
_TILES = 4  # largest number of pictures in a row or a column of a photo
_HALVES: tuple[Part, ...] = ((0, 0, 0.5, 1), (0.5, 0, 1, 1), (0, 0, 1, 0.5), (0, 0.5, 1, 1))


@dataclass(frozen=True)
class PartFit:
    """The part of each photo that its view shows."""

    part: Part = WHOLE
    # The part is stretched to the aspect ratio of the size ``shape``, because stereo films squeeze pictures; None: not
    # stretched
    shape: Size | None = None

    def cut(self, photo: np.ndarray) -> np.ndarray:
        """Cut the part out of an upright photo ``[h,w,3]``, and stretch it."""
        part = cut_part(photo, self.part)
        size, new_size = part.shape[1::-1], self.stretch(part.shape[1::-1])
        return part if size == new_size else resize_to(size, new_size).photos([part])[0]

    def stretch(self, size: Size) -> Size:
        """Return the size to which a part of a ``size`` is stretched; the same size if parts are not stretched."""
        if self.shape is None:
            return size
        scale = max(size[0] / self.shape[0], size[1] / self.shape[1])
        return round(scale * self.shape[0]), round(scale * self.shape[1])

    def describe(self, size: Size, *, bars: bool) -> str:
        """Return a note on which part of photos of a ``size`` is used; with ``bars``, only bars are cut off."""
        photo_text, part = "{} x {}".format(*size), part_size(size, self.part)
        part_text, ratio = "{} x {}".format(*part), self.stretch(part)[0] * part[1] / (part[0] * self.stretch(part)[1])
        if bars:
            return f"bars around the photos are cut off: {photo_text} pixels become {part_text}"
        corner = f" from column {round(size[0] * self.part[0])} and line {round(size[1] * self.part[1])} on"
        stretched = f", stretched to {max(ratio, 1 / ratio):.2f} times their {'width' if ratio > 1 else 'height'}"
        part_name = "photos" if self.part == WHOLE else f"the {part_text} pixels{corner} of photos"
        used = f"{part_name} of {photo_text} are used{stretched if self.shape else ''}"
        return f"{used}, since they fit the Gaussians best"


WHOLE_FIT = PartFit()


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


@dataclass(frozen=True)
class GridFit:
    """How a model resized and cropped photos to a grid; the Gaussians of its pixels are the rows of a file."""

    size: Size  # size of the grid
    crops: bool = False  # True: resized in proportion and cropped at the centre; False: resized without proportion
    trim: tuple[int, int] = (0, 0)  # columns and lines that the model cut off its output at each side

    def transform(self, size: Size) -> PhotoTransform:
        """Return the transform of photos of a ``size`` to the grid before the model cut off borders."""
        width, height = (side + 2 * cut for side, cut in zip(self.size, self.trim, strict=True))
        return (resize_and_crop if self.crops else resize_to)(size, (width, height))

    def cut(self, photo: np.ndarray) -> np.ndarray:
        """Resize and crop a photo ``[h,w,3]`` of any size to the pixels of the grid.

        If only the photo or only the grid is portrait, the photo is turned first, and the result is turned back.
        """
        (width, height), (left, top) = self.size, self.trim
        if (photo.shape[1] - photo.shape[0]) * (width - height) < 0:
            return np.rot90(self.cut(np.ascontiguousarray(np.rot90(photo))), -1)
        whole = self.transform((photo.shape[1], photo.shape[0])).photos([photo])[0]
        return np.asarray(whole[top : top + height, left : left + width])

    def cameras(self, camera_file: CameraFile, size: Size) -> CameraFile:
        """Return the cameras of the grid as they were before the model cut off borders.

        The ``photo_map`` of these cameras is the transform of photos of a ``size``.
        """
        (left, top), (width, height), Ks = self.trim, self.size, camera_file.Ks.copy()
        assert camera_file.pixel_ids is not None, "estimated cameras are those of pixels"
        Ks[:, :2, 2] += self.trim
        widths, heights = camera_file.widths + 2 * left, camera_file.heights + 2 * top
        lines, x = np.divmod(camera_file.pixel_ids, width)
        views, y = np.divmod(lines, height)
        pixel_ids = (views * (height + 2 * top) + y + top) * (width + 2 * left) + x + left
        pixel_ids = np.where(lines >= 0, pixel_ids, -1)
        photo_map = size, self.transform(size)
        return replace(camera_file, Ks=Ks, widths=widths, heights=heights, pixel_ids=pixel_ids, photo_map=photo_map)


def _da3_borders(side: int) -> list[int]:
    """List how many pixels Depth Anything 3 may have cut off at each end of a side of which ``side`` pixels are left.

    Depth Anything 3 cuts off 8 of 256 pixels, rounded down.
    """
    return [border for border in range(side) if int(8 / 256 * (side + 2 * border)) == border]


FitT = TypeVar("FitT", bound=GridFit | PartFit)


def list_fits(size: Size) -> list[GridFit]:
    """List the ways in which models resize and crop photos to a grid of a ``size``, simple ones first."""
    trims = [(trim, trim) for trim in (0, *TRIMS)]
    trims += product(_da3_borders(size[0]), _da3_borders(size[1]))
    return [GridFit(size, crops, trim) for crops in (False, True) for trim in dict.fromkeys(trims)]


def choose_fit(shown: ViewPictures, photos: Sequence[np.ndarray | None], fits: Sequence[FitT]) -> FitT:
    """Choose the fit with which photos ``[h,w,3]`` match the pictures of their views best.

    A later fit is chosen only if it matches significantly better than the best of the earlier fits.
    """
    views = [view for view, photo in enumerate(photos) if photo is not None]

    def correlate(fit: FitT) -> np.ndarray:
        """Return the correlations of all parts of all photos after a fit."""
        return np.concatenate([
            correlate_parts(shown, view, fit.cut(photos[view]))  # type: ignore[arg-type]
            for view in views
        ])  # fmt: skip

    best, best_correlations = fits[0], correlate(fits[0])
    for fit in fits[1:]:
        correlations = correlate(fit)
        if stands_out(correlations - best_correlations):
            best, best_correlations = fit, correlations
    return best


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
