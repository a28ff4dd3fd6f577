"""Gaussians, cameras and photos -> a map for each view of how far off a new view from there is likely to be.

A result has seen the photos of its own views, so its error there says little. So each pixel's surface, as the result
has it, is looked up in the nearest photos of other views, and what they show there is compared with what is drawn.
Where none of them looks, nothing but the view's own photo speaks for what is drawn.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.frame import scene_frame
from gsmerge.geometry import is_inside, project
from gsmerge.kernels.pictures import blur, sample_bilinear
from gsmerge.measure.preview import Picture, contact_sheet, to_picture
from gsmerge.measure.sizes import resize_mask, shrink_cameras, shrink_views
from gsmerge.measure.visibility import lift_pixels
from gsmerge.raster import render
from gsmerge.raster.photos import NEAR_PLANE
from gsmerge.types import Cameras, Gaussians, Scene, Views

SIDE = 320  # pixels, at most, of the longer side of a map
# Nearest other photos that are asked, and how many of those that see a surface count, the nearest: held-out errors of
# four captures rank as those by two (0.53 to 0.63), less as those by four (0.44 to 0.58): some show what stands before
NEIGHBORS, COUNTED = 8, 2
NEEDED = 2  # views with photos, for each to have another
OPAQUE = 0.5  # opacity from which on a pixel shows a surface
BEHIND = 1.05  # times the depth that the other view has there, from which on it is hidden from it
SIGMA = 2.0  # pixels that errors are averaged over: their sum in a pixel is chance
MOST = 0.2  # error, of the range of a channel, from which on it has the last colour
STOPS = ((0, 0, 4), (87, 16, 110), (188, 55, 84), (249, 142, 9), (252, 255, 164))  # of errors, even steps; sRGB
UNKNOWN = (0, 130, 140)  # where no other photo looks


@dataclass(frozen=True, eq=False)
class Witnesses:
    """Photos that say how far off a canonical scene is, and how deep it sees from them."""

    gaussians: Gaussians
    views: Views  # canonical cameras, photos of at most SIDE pixels
    masks: np.ndarray | None  # [v,h,w] bool, where these count; None: everywhere
    looks: dict[int, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)  # of views that were drawn

    def look(self, view: int) -> tuple[np.ndarray, np.ndarray]:
        """Draw the picture and the depth of a view as :func:`look_from`, once."""
        if view not in self.looks:
            self.looks[view] = look_from(self.gaussians, self.views.cameras[[view]])
        return self.looks[view]


def call_witnesses(gaussians: Gaussians, views: Views, masks: np.ndarray | None = None) -> Witnesses:
    """Take the photos of canonical ``views``, where ``masks [v,h,w]`` let them, for witnesses of a canonical scene."""
    small = shrink_views(views, SIDE)
    size = small.cameras.width, small.cameras.height
    return Witnesses(gaussians, small, None if masks is None else np.stack([resize_mask(one, *size) for one in masks]))


def expected_errors(witnesses: Witnesses, camera: Cameras, own: int | None = None) -> np.ndarray:
    """Measure by the photos of other views how far off a canonical camera's picture is likely to be.

    Returns ``[h,w]`` float32 of at most ``SIDE`` pixels a side: mean absolute differences of the channels, in [0, 1],
    from the nearest photos that see the surface there; NaN where none does. ``own``: the view of the camera, whose
    photo does not count.
    """
    camera = shrink_cameras(camera, SIDE)
    image, depth = look_from(witnesses.gaussians, camera) if own is None else witnesses.look(own)
    ids = np.flatnonzero(depth > 0)
    points, colors = lift_pixels(depth, depth > 0, camera), image.reshape(-1, 3).take(ids, 0)
    sums, counts = np.zeros((2, len(ids)), np.float32)
    open_rows, small = np.arange(len(ids)), witnesses.views.cameras
    for other in _nearest(small, camera, own):
        (pixels,), (z,) = project(points.take(open_rows, 0), small[[other]])
        seen = np.flatnonzero((z > 0) & is_inside(pixels, small))
        pixels, rows = pixels.take(seen, 0), open_rows.take(seen)
        column, row = pixels.astype(np.int64).T
        there = row * small.width + column
        shown = z.take(seen) < BEHIND * witnesses.look(other)[1].reshape(-1).take(there)
        if witnesses.masks is not None:
            shown &= witnesses.masks[other].reshape(-1).take(there)
        pixels, rows = pixels.compress(shown, 0), rows.compress(shown)
        apart = np.abs(sample_bilinear(witnesses.views.images[other], *(pixels.T - 0.5)) - colors.take(rows, 0))
        sums[rows] += (apart[:, 0] + apart[:, 1] + apart[:, 2]) / np.float32(3)
        counts[rows] += 1
        open_rows = open_rows.compress(counts.take(open_rows) < COUNTED)
    errors = np.zeros((depth.size, 2), np.float32)
    errors[ids, 0], errors[ids, 1] = sums / np.maximum(counts, 1), counts > 0
    errors = errors.reshape(*depth.shape, 2)
    known = errors[..., 1] > 0
    total, weight = np.moveaxis(blur(errors, SIGMA), 2, 0)
    return np.where(known, total / np.maximum(weight, np.float32(1e-6)), np.float32(np.nan))


def draw_errors(errors: np.ndarray) -> Picture:
    """Draw errors ``[h,w]``: from black over red to yellow, which is 0.2 or more, and teal where nothing is known."""
    places = np.nan_to_num(errors).clip(0, MOST) * ((len(STOPS) - 1) / MOST)
    colors = [np.interp(places, range(len(STOPS)), channel) for channel in np.array(STOPS).T]
    return np.where(np.isnan(errors)[..., None], UNKNOWN, np.stack(colors, 2)).round().astype(np.uint8)


def look_from(gaussians: Gaussians, camera: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Draw the picture ``[h,w,3]`` and the depth ``[h,w]``, 0 where nothing is opaque, of a camera."""
    drawn = render(gaussians, camera, near=NEAR_PLANE, with_depths=True)
    assert drawn.depths is not None
    (depth,), (alpha,) = drawn.depths[..., 0], drawn.alphas[..., 0]
    return drawn.images[0].clip(0, 1), np.where(alpha > OPAQUE, depth, np.float32(0))


def _nearest(cameras: Cameras, camera: Cameras, own: int | None) -> list[int]:
    """Return the nearest other views of a camera, the nearest first."""
    away = np.square(cameras.centres - camera.centres[0]).sum(1)
    order = [int(view) for view in np.argsort(away, kind="stable") if view != own]
    return order[:NEIGHBORS]


def require_photos(scene: Scene, path: Path) -> None:
    """Raise SceneError with the ``path`` of a scene unless two of its views or more have a photo."""
    count = 0 if scene.images is None else len(scene)
    if scene.images is not None and scene.masks is not None:  # a view without a photo has an empty mask
        count = int(scene.masks.any((1, 2)).sum())
    if count < NEEDED:
        problem = f"expected photos of {NEEDED} views or more for maps, which compare each with others; found {count}"
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

    Yields (result, number of the view among all, the input views first, sheet). ``cameras`` are those of the input
    views by name of a result that was made with others; without ``context`` held-out views alone are drawn. The
    scene has photos, see :func:`require_photos`.
    """
    assert scene.images is not None
    frame = scene_frame(scene)
    for name, gaussians in results.items():
        placed = frame.enter_cameras(cameras.get(name, scene.cameras))
        witnesses = call_witnesses(frame.enter(gaussians), Views(placed, scene.images, scene.names), scene.masks)
        views: list[tuple[Views, int, int | None]] = [(witnesses.views, view, view) for view in range(len(placed))]
        if targets is not None:
            held_out = shrink_views(replace(targets, cameras=frame.enter_cameras(targets.cameras)), SIDE)
            views += [(held_out, view, None) for view in range(len(held_out))]
        for number, (of, view, own) in enumerate(views):
            if own is not None and not (context and (scene.masks is None or scene.masks[view].any())):
                continue
            camera = of.cameras[[view]]
            drawn, _ = look_from(witnesses.gaussians, camera) if own is None else witnesses.look(own)
            errors = expected_errors(witnesses, camera, own)
            pictures = to_picture(of.images[view]), to_picture(drawn), draw_errors(errors)
            known = errors[~np.isnan(errors)]
            mean = f"error {known.mean():.3f}, " if len(known) else ""
            said = f"{mean}yellow {MOST}; teal, {100 * (1 - len(known) / errors.size):.0f} %, unknown"
            texts = f"view {number}: {of.names[view]}{'' if own is not None else ', held out'}", name, said
            yield name, number, contact_sheet([list(zip(texts, pictures, strict=True))])
