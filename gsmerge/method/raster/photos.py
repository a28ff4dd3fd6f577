"""Hold photos with their cameras at full or reduced size, and score renders against them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.method.geometry.transforms import median, sh0_to_rgb
from gsmerge.method.kernels.raster.project import TILE
from gsmerge.method.raster.composite import composite
from gsmerge.method.raster.metrics import MAX_PSNR, psnr_within
from gsmerge.method.raster.tiled_view import EPS2D, Splats, make_splats, tile_view
from gsmerge.runtime.memory import make_array
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Gaussians, Scene

Score = TypeVar("Score")

LEAST_OPACITY = 1 / 255  # rasterizers draw no smaller opacity
NEAR_PLANE = 0.01  # near plane of every render that is scored, in canonical units
# Scenes of more than ERRORS_ONE_AT_A_TIME Gaussians are rendered view by view, because a tiled view takes about as much
# memory as the Gaussians. When scenes are rendered view by view, all threads share one view
ERRORS_ONE_AT_A_TIME = 400_000
# Scored tiles are shifted by TILE_STEP columns, a prime, from one line of tiles to the next. At least LEAST_TILES of a
# view are scored, so small views are scored whole. With 48 tiles, a PSNR gain on six views of 256 x 480 pixels seemed
# 1.0 dB larger than it was
TILE_STEP = 13
LEAST_TILES = 100
MASKED_WEIGHT = np.float32(0.1)  # weight of pixels outside masks; with 0, Gaussians there would drift
COVERED_TRANSMITTANCE = np.float32(0.5)  # transmittance below which a pixel counts as covered by Gaussians
WHOLE_SHARE = 0.98  # share of covered pixels from which on the whole view counts as covered


class RenderScore(NamedTuple):
    """Score of one render against a photo."""

    psnr: float  # dB over the scored pixels, which are inside the photo's mask and inside the scored tiles
    covered_psnr: float  # dB over the scored pixels that are covered; psnr if share >= WHOLE_SHARE, NaN if it is 0
    share: float  # share of the scored pixels that are covered
    covered: np.ndarray  # [h,w] bool, the scored pixels that are covered


@dataclass(frozen=True, eq=False)
class PhotoScore:
    """Mean of the scores of several renders, see :class:`RenderScore`."""

    psnr: float  # dB
    covered_psnr: float  # dB; NaN if no view has covered pixels
    share: float  # mean share of covered pixels
    covered: tuple[np.ndarray, ...]  # [h,w] bool for each view


@dataclass(frozen=True)
class Sample:
    """Every ``stride``-th column and row of a photo, from ``column`` and ``row`` on.

    The sampled pixels form a smaller photo. The camera of the smaller photo projects to the centres of the sampled
    pixels, with the low-pass of the whole photo.
    """

    stride: int = 1
    column: int = 0
    row: int = 0

    @property
    def pixels(self) -> tuple[slice, slice]:
        """Rows and columns of the sample."""
        return slice(self.row, None, self.stride), slice(self.column, None, self.stride)


WHOLE_PHOTO = Sample()


@dataclass(frozen=True, eq=False)
class Photos:
    """V photos of one size, with their cameras and pixel weights."""

    images: np.ndarray  # [v,h,w,3] float32 sRGB in [0, 1], or uint8 if photos are larger than the grid; see image()
    viewmats: np.ndarray  # [v,4,4] world to camera
    Ks: np.ndarray  # [v,3,3] intrinsics at this size
    # Variance of the low-pass, in square pixels of these photos. The low-pass is scaled from the low-pass of full-size
    # photos, so that a fit filters Gaussians as the final render does
    eps2d: float
    weights: np.ndarray | None = None  # [v,h,w] float32, weight of each pixel in [0, 1], by default 1
    empty: np.ndarray | None = None  # [v,h,w] float32 share of each pixel that shows the background, by default 0
    importance: np.ndarray | None = None  # [v,h,w] float32, weight of each pixel in a fit, by default 1
    antialiased: bool = False  # whether viewers draw the Gaussians antialiased

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, views: Sequence[int]) -> Photos:
        """Select the photos of some views, without a copy if they are consecutive."""
        ids: list[int] | slice = list(views)
        if views and ids == list(range(views[0], views[0] + len(views))):
            ids = slice(views[0], views[0] + len(views))
        weights, empty, importance = (
            None if values is None else values[ids] for values in (self.weights, self.empty, self.importance)
        )
        return replace(
            self, images=self.images[ids], viewmats=self.viewmats[ids], Ks=self.Ks[ids],
            weights=weights, empty=empty, importance=importance,
        )  # fmt: skip

    @property
    def height(self) -> int:
        """Number of rows."""
        return self.images.shape[1]

    @property
    def width(self) -> int:
        """Number of columns."""
        return self.images.shape[2]

    def image(self, view: int, background: np.ndarray | None = None, sample: Sample = WHOLE_PHOTO) -> np.ndarray:
        """Return the photo ``[h,w,3]`` of a view, sRGB in [0, 1], or a sample of its pixels.

        Where ``empty`` is above 0, a ``background [3]`` shows through.
        """
        image = self.images[view][sample.pixels]
        image = np.multiply(image, np.float32(1 / 255), dtype=np.float32) if image.dtype == np.uint8 else image
        if self.empty is None or background is None:
            return image
        return np.asarray(image + self.empty[view][sample.pixels][..., None] * background, np.float32)

    def camera(self, view: int, sample: Sample = WHOLE_PHOTO) -> dict[str, Any]:
        """Return the arguments of :func:`gsmerge.method.raster.tile_view` for a view's photo, or a sample of it."""
        K = self.Ks[view]
        stride = sample.stride
        offset = np.array([sample.column, sample.row])
        if stride > 1:  # column i of the sample is column stride * i + offset of the photo; both have centres at +0.5
            K = K / np.array([[stride], [stride], [1.0]])
            K[:2, 2] += ((stride - 1) / 2 - offset) / stride
        return {
            "viewmat": self.viewmats[view],
            "K": K,
            "width": len(range(sample.column, self.width, stride)),
            "height": len(range(sample.row, self.height, stride)),
            "eps2d": self.eps2d / stride**2,
            "antialiased": self.antialiased,
        }


def scene_pictures(scene: Scene) -> np.ndarray:
    """Return a scene's photos ``[v,h,w,3]``, or without photos the base colours of the Gaussians in front."""
    return row_pictures(scene) if scene.images is None else scene.images


def row_pictures(scene: Scene) -> np.ndarray:
    """Return the base colours ``[v,h,w,3]`` of the Gaussians in front of a scene's pixels, 0 where there is none."""
    sh0, pixels = scene.gaussians.sh0[:, 0], scene.get_pixels()
    pictures = make_array((*pixels.fronts.shape, 3), np.float32)

    def draw(view: int) -> None:
        """Write the picture of one view."""
        fronts = pixels.fronts[view]
        picture = pictures[view]
        np.clip(sh0_to_rgb(sh0.take(fronts, axis=0)), 0, 1, out=picture)
        if (fronts < 0).any():
            picture[fronts < 0] = 0

    parallel_map(draw, range(len(pictures)))
    return pictures


def scene_photos(scene: Scene, level: float = 1) -> Photos:
    """Return the scene's photos with their cameras, shrunk by area averages to sides / ``level``."""
    if scene.images is None:
        raise ValueError("expected a scene with images")
    photos = photos_of(scene.images, scene.cameras, level)
    return with_pixel_values(photos, scene)


def with_pixel_values(photos: Photos, scene: Scene) -> Photos:
    """Add the weights and the importance of the scene's pixels to its photos, which may have any size."""
    size = photos.width, photos.height
    important = None if scene.importance is None else shrink_pictures(scene.importance, *size)
    return replace(photos, weights=pixel_weights(scene.masks, *size), importance=important)


def counting_pixels(scene: Scene) -> np.ndarray:
    """Return the mask ``[v,h,w]`` of the pixels that count: the scene's masks, without masks all."""
    shape = len(scene), scene.cameras.height, scene.cameras.width
    return np.full(shape, True) if scene.masks is None else scene.masks


def row_shares(scene: Scene) -> np.ndarray:
    """Return how many pixels of each view ``[v]`` have a Gaussian, relative to how many views usually have."""
    shares = scene.get_pixels().shown.mean((1, 2))
    return np.asarray(shares / max(median(shares), 1e-9))


def pixel_weights(masks: np.ndarray | None, width: int, height: int) -> np.ndarray | None:
    """Convert masks ``[v,h,w]`` to pixel weights ``[v,height,width]``: 1 inside, ``MASKED_WEIGHT`` outside.

    A pixel of the smaller photo is inside if all pixels of the mask that it covers are inside.
    """
    if masks is None:
        return None
    size = width, height
    levels = [cv2.resize(mask.astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA) for mask in masks]
    return np.where(np.stack(levels) == 255, np.float32(1), MASKED_WEIGHT)


def photos_of(images: np.ndarray, cameras: Cameras, level: float = 1) -> Photos:
    """Combine photos ``[v,h,w,3]`` with their cameras, and shrink them by area averages to sides / ``level``."""
    blank = blank_photos(cameras, level)
    return replace(blank, images=images if level == 1 else shrink_pictures(images, blank.width, blank.height))


def shrink_pictures(pictures: np.ndarray, width: int, height: int) -> np.ndarray:
    """Shrink pictures ``[v,h,w,...]`` to ``[v,height,width,...]`` by area averages."""
    small = make_array((len(pictures), height, width, *pictures.shape[3:]), pictures.dtype.type)

    def shrink(view: int) -> None:
        """Write the small picture of one view."""
        small[view] = cv2.resize(pictures[view], (width, height), interpolation=cv2.INTER_AREA)

    parallel_map(shrink, range(len(pictures)))
    return small


def blank_photos(cameras: Cameras, level: float = 1) -> Photos:
    """Return black photos for the cameras, with sides / ``level``, to draw views that have no photo.

    The black images take no memory.
    """
    viewmats = cameras.viewmats.astype(np.float64)
    Ks = cameras.Ks.astype(np.float64)
    w = cameras.width
    h = cameras.height
    width = max(1, round(w / level))
    height = max(1, round(h / level))
    black = np.broadcast_to(np.float32(0), (len(cameras), height, width, 3))
    sx = width / w
    sy = height / h
    return Photos(black, viewmats, Ks * np.array([[sx], [sy], [1.0]]), EPS2D * sx * sy, antialiased=cameras.antialiased)


def photo_errors(
    gaussians: Gaussians | Splats,
    photos: Photos,
    score: Callable[[int, np.ndarray, np.ndarray], Score],
    views: Iterable[int] | None = None,
    *,
    near: float = NEAR_PLANE,
    colors: np.ndarray | None = None,
    keep: Callable[[int], np.ndarray] | None = None,
    tiles: Callable[[int], np.ndarray | None] | None = None,
) -> list[Score]:
    """Render Gaussians into the photos' cameras, several views at once, and return the score of every render.

    Args:
        gaussians: n Gaussians.
        photos: The photos, whose cameras are used.
        score: ``score(view, render, transmittance)`` returns the score of a render ``[h,w,3]``, which is not clipped.
        views: The views in the order of the result, by default all.
        near: Depth of the near plane, in the unit of the Gaussians.
        colors: Colours ``[n,3]`` that replace the harmonics.
        keep: ``keep(view)`` returns a mask ``[n]`` of the Gaussians to draw, by default all.
        tiles: ``tiles(view)`` returns a mask ``[tile_height,tile_width]`` of tiles that have to be complete, by default
            all.
    """
    splats = gaussians if isinstance(gaussians, Splats) else make_splats(gaussians)

    def score_view(view: int) -> Score:
        """Render one view, and return its score."""
        shown, complete = (None if choose is None else choose(view) for choose in (keep, tiles))
        tiled = tile_view(splats, **photos.camera(view), near=near, keep=shown, tiles=complete)
        return score(view, *composite(tiled, colors))

    view_ids = range(len(photos)) if views is None else views
    if len(splats) > ERRORS_ONE_AT_A_TIME:
        return [score_view(view) for view in view_ids]
    return parallel_map(score_view, view_ids)


def score_photos(
    gaussians: Gaussians | Splats,
    photos: Photos,
    views: Sequence[int],
    *,
    every: int = 1,
    covered: Sequence[np.ndarray] | None = None,
    **settings: Any,
) -> PhotoScore:
    """Score renders of Gaussians against the photos of ``views``.

    One of ``every`` tiles is scored, see :func:`scored_tiles`. ``covered`` has a mask ``[h,w]`` of the covered pixels
    for each of the views. By default a pixel is covered if its opacity is above a half. ``settings`` are options of
    :func:`photo_errors`.
    """
    masks = {} if covered is None else dict(zip(views, covered, strict=True))

    def tiles(view: int) -> np.ndarray | None:
        """Return the tiles of a view that have to be complete, because they are scored."""
        return scored_tiles(view, photos.width, photos.height, every)

    def score_render(view: int, image: np.ndarray, transmittance: np.ndarray) -> RenderScore:
        """Score the render of one view over all scored pixels and over covered pixels. The render is clipped."""
        covered_pixels = masks.get(view, transmittance < COVERED_TRANSMITTANCE)
        mask = _scored_pixels(photos, view, every)
        covered_pixels = covered_pixels if mask is None else covered_pixels & mask
        share = float(covered_pixels.sum() / (covered_pixels.size if mask is None else max(1, mask.sum())))
        compared = [mask, covered_pixels] if 0 < share < WHOLE_SHARE else [mask]
        psnrs = psnr_within(np.clip(image, 0, 1, out=image), photos.images[view], compared)
        return RenderScore(psnrs[0], psnrs[-1] if share else math.nan, share, covered_pixels)

    scores = photo_errors(gaussians, photos, score_render, views, tiles=tiles, **settings)
    # each PSNR counts as at most MAX_PSNR, because it may be infinite
    covered_psnrs = [min(score.covered_psnr, MAX_PSNR) for score in scores if score.share > 0]
    share = float(np.mean([score.share for score in scores]))
    mean = float(np.mean([min(score.psnr, MAX_PSNR) for score in scores]))
    covered_mean = float(np.mean(covered_psnrs)) if covered_psnrs else math.nan
    return PhotoScore(mean, covered_mean, share, tuple(score.covered for score in scores))


def _scored_pixels(photos: Photos, view: int, every: int) -> np.ndarray | None:
    """Return the mask ``[h,w]`` of the pixels that are scored, or None for all pixels.

    Pixels are scored inside the photo's mask and inside the scored tiles. If no pixel is inside both, all pixels of the
    photo's mask are scored. If the photo's mask is empty, all pixels of the scored tiles are scored.
    """
    tiles = scored_tiles(view, photos.width, photos.height, every)
    in_tiles = None if tiles is None else tiles.repeat(TILE, 0).repeat(TILE, 1)[: photos.height, : photos.width]
    if photos.weights is None:
        return in_tiles
    unmasked = photos.weights[view] == 1
    both = unmasked if in_tiles is None else in_tiles & unmasked
    return next((mask for mask in (both, unmasked) if mask.any()), in_tiles)


def scored_tiles(view: int, width: int, height: int, every: int) -> np.ndarray | None:
    """Return a mask ``[tile_height,tile_width]`` of the tiles of a view that are scored, or None for all tiles.

    One of ``every`` tiles is scored, but at least ``LEAST_TILES`` of a view. The scored tiles are spread evenly, and
    differ from view to view.
    """
    tile_height = -(-height // TILE)
    tile_width = -(-width // TILE)
    every = min(every, tile_height * tile_width // LEAST_TILES)
    if every <= 1:
        return None
    lines = view + np.arange(tile_height)[:, None]
    return np.asarray((TILE_STEP * lines + np.arange(tile_width)) % every == 0)


def render_photos(gaussians: Gaussians | Splats, photos: Photos, **settings: Any) -> list[np.ndarray]:
    """Return the render ``[h,w,3]`` of every view, not clipped, with the ``settings`` of :func:`photo_errors`."""
    return photo_errors(gaussians, photos, lambda _, image, __: image, **settings)
