"""Draw a map for each camera of the likely error of a new view there, from Gaussians, cameras and photos.

A result was fitted to the photos of its own views, so its error on these says little. Instead, the surface of each
pixel, as the result has it, is projected into the nearest photos of other views, and their colours are compared with
the render. Where no other photo shows the surface, only the view's own photo supports the render.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.frame import scene_frame
from gsmerge.kernels.pictures import blur
from gsmerge.kernels.reproject import add_photo_errors
from gsmerge.measure.preview import Picture, contact_sheet, to_picture
from gsmerge.measure.sizes import resize_mask, shrink_cameras, shrink_views
from gsmerge.measure.visibility import lift_pixels
from gsmerge.raster import render
from gsmerge.raster.photos import NEAR_PLANE
from gsmerge.types import Cameras, Gaussians, Scene, Views

SIDE = 320  # largest longer side of a map, pixels
# Number of nearest other photos that are compared. Of the photos that see a pixel's surface, the nearest COUNTED count.
# The rank correlation with held-out errors of four captures is 0.53 to 0.63 with two, and 0.44 to 0.58 with four, since
# some photos show an object in front of the surface
NEIGHBORS, COUNTED = 8, 2
MIN_PHOTOS = 2  # each photo needs another photo to compare with
OPAQUE = 0.5  # least opacity of a pixel that shows a surface
BEHIND = 1.05  # a surface is hidden in another view if its depth there exceeds the drawn depth by this factor
SIGMA = 2.0  # standard deviation, pixels, of the blur of errors; the error of a single pixel is random
MAX_ERROR = 0.2  # error with the last colour, as a share of a channel's range
STOPS = ((0, 0, 4), (87, 16, 110), (188, 55, 84), (249, 142, 9), (252, 255, 164))  # colours of errors, sRGB
UNKNOWN = (0, 130, 140)  # colour of pixels that no other photo shows


@dataclass(frozen=True, eq=False)
class ErrorReference:
    """A canonical scene and the photos by which its errors are estimated."""

    gaussians: Gaussians
    views: Views  # canonical cameras, photos of at most SIDE pixels
    masks: np.ndarray | None  # [v,h,w] bool, pixels inside the photos' masks; None: all
    drawn: dict[int, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)  # picture and depth by view

    def draw(self, view: int) -> tuple[np.ndarray, np.ndarray]:
        """Draw picture and depth of a view as :func:`draw_camera` does, and keep them."""
        if view not in self.drawn:
            self.drawn[view] = draw_camera(self.gaussians, self.views.cameras[[view]])
        return self.drawn[view]


def make_reference(gaussians: Gaussians, views: Views, masks: np.ndarray | None = None) -> ErrorReference:
    """Shrink canonical ``views`` with photos, and ``masks [v,h,w]``, to a reference for the errors of a scene."""
    small = shrink_views(views, SIDE)
    size = small.cameras.width, small.cameras.height
    resized = None if masks is None else np.stack([resize_mask(mask, *size) for mask in masks])
    return ErrorReference(gaussians, small, resized)


def expected_errors(reference: ErrorReference, camera: Cameras, own: int | None = None) -> np.ndarray:
    """Estimate the likely error of a canonical camera's picture by the photos of other views.

    Returns ``[h,w]`` float32, at most ``SIDE`` pixels per side: the mean absolute difference of the channels, in
    [0, 1], between a pixel and the nearest photos that show its surface; NaN if no photo shows it. ``own`` is the view
    of the camera, whose photo does not count.
    """
    camera = shrink_cameras(camera, SIDE)
    image, depth = draw_camera(reference.gaussians, camera) if own is None else reference.draw(own)
    ids = np.flatnonzero(depth > 0)
    points, colors = lift_pixels(depth, depth > 0, camera), image.reshape(-1, 3).take(ids, 0)
    sums, counts = np.zeros((2, len(ids)), np.float32)
    for view in _nearest(reference.views.cameras, camera, own):
        _add_errors(reference, view, points, colors, sums, counts)
    means, known = np.zeros((2, depth.size), np.float32)
    means[ids], known[ids] = sums / np.maximum(counts, 1), counts > 0
    layers = np.stack([means, known], 1).reshape(*depth.shape, 2)
    total, weight = np.moveaxis(blur(layers, SIGMA), 2, 0)
    smooth = total / np.maximum(weight, np.float32(1e-6))
    return np.where(layers[..., 1] > 0, smooth, np.float32(np.nan))


def _add_errors(
    reference: ErrorReference, view: int, points: np.ndarray, colors: np.ndarray, sums: np.ndarray, counts: np.ndarray
) -> None:
    """Add the errors of ``points [n,3]`` with ``colors [n,3]`` in a view's photo to ``sums [n]``, and 1 to ``counts``.

    A photo shows a point that is inside the picture and the mask, and that no drawn surface hides.
    """
    views, masks = reference.views, reference.masks
    viewmat, K = (array[view].astype(np.float64) for array in (views.cameras.viewmats, views.cameras.Ks))
    mask = None if masks is None else np.ascontiguousarray(masks[view]).view(np.uint8)
    photo, depths = (np.ascontiguousarray(array, np.float32) for array in (views.images[view], reference.draw(view)[1]))
    add_photo_errors(points, colors, viewmat, K, photo, depths, mask, BEHIND, COUNTED, sums, counts)


def draw_errors(errors: np.ndarray) -> Picture:
    """Colour errors ``[h,w]`` from black over red to yellow (0.2 or more), and teal where the error is not known."""
    positions = np.nan_to_num(errors).clip(0, MAX_ERROR) * ((len(STOPS) - 1) / MAX_ERROR)  # among the colour stops
    colors = [np.interp(positions, range(len(STOPS)), channel) for channel in np.array(STOPS).T]
    return np.where(np.isnan(errors)[..., None], UNKNOWN, np.stack(colors, 2)).round().astype(np.uint8)


def draw_camera(gaussians: Gaussians, camera: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Draw the picture ``[h,w,3]`` and the depth ``[h,w]``, 0 where nothing is opaque, of one camera."""
    drawn = render(gaussians, camera, near=NEAR_PLANE, with_depths=True)
    assert drawn.depths is not None
    (depth,), (alpha,) = drawn.depths[..., 0], drawn.alphas[..., 0]
    return drawn.images[0].clip(0, 1), np.where(alpha > OPAQUE, depth, np.float32(0))


def _nearest(cameras: Cameras, camera: Cameras, own: int | None) -> list[int]:
    """Return the other views nearest to a camera, the nearest first."""
    distances = np.square(cameras.centres - camera.centres[0]).sum(1)
    order = [int(view) for view in np.argsort(distances, kind="stable") if view != own]
    return order[:NEIGHBORS]


def require_photos(scene: Scene, path: Path) -> None:
    """Raise SceneError with the ``path`` of a scene unless at least two of its views have a photo."""
    count = 0 if scene.images is None else len(scene)
    if scene.images is not None and scene.masks is not None:  # a view without a photo has an empty mask
        count = int(scene.masks.any((1, 2)).sum())
    if count < MIN_PHOTOS:
        problem = f"expected photos of at least {MIN_PHOTOS} views for maps, which compare photos, found {count}"
        raise SceneError(path, problem, "name their folder with --images")


def draw_sheets(
    scene: Scene,
    results: Mapping[str, Gaussians],
    targets: Views | None,
    cameras: Mapping[str, Cameras],
    *,
    context: bool = True,
) -> Iterator[tuple[str, int, Picture]]:
    """Draw the photo, the picture and the map of each result and view, side by side.

    Yields (result, number of the view among all views, sheet); the input views come first. ``cameras`` has the cameras
    of the input views, by name of each result whose cameras differ from the scene's. Without ``context`` only held-out
    views are drawn. The scene must have photos, see :func:`require_photos`.
    """
    assert scene.images is not None
    frame = scene_frame(scene)
    for name, gaussians in results.items():
        placed = frame.enter_cameras(cameras.get(name, scene.cameras))
        reference = make_reference(frame.enter(gaussians), Views(placed, scene.images, scene.names), scene.masks)
        views: list[tuple[Views, int, int | None]] = [(reference.views, view, view) for view in range(len(placed))]
        if targets is not None:
            held_out = shrink_views(replace(targets, cameras=frame.enter_cameras(targets.cameras)), SIDE)
            views += [(held_out, view, None) for view in range(len(held_out))]
        for number, (source, view, own) in enumerate(views):
            if own is not None and not (context and (scene.masks is None or scene.masks[view].any())):
                continue
            title = f"view {number}: {source.names[view]}{'' if own is not None else ', held out'}"
            yield name, number, _draw_sheet(reference, source, view, own, (title, name))


def _draw_sheet(
    reference: ErrorReference, source: Views, view: int, own: int | None, texts: tuple[str, str]
) -> Picture:
    """Draw photo, picture and map of a view of ``source``; ``texts`` are the labels of the first two."""
    camera = source.cameras[[view]]
    drawn, _ = draw_camera(reference.gaussians, camera) if own is None else reference.draw(own)
    errors = expected_errors(reference, camera, own)
    pictures = to_picture(source.images[view]), to_picture(drawn), draw_errors(errors)
    known = errors[~np.isnan(errors)]
    mean = f"error {known.mean():.3f}, " if len(known) else ""
    legend = f"{mean}yellow {MAX_ERROR}; teal, {100 * (1 - len(known) / errors.size):.0f} %, unknown"
    return contact_sheet([list(zip((*texts, legend), pictures, strict=True))])
