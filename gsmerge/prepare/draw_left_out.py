"""Scene -> the scene whose pictures show the input itself, with its opacity, in pixels where photos do not count.

Masks, transparency and uniform backgrounds leave out pixels. What the input shows decides what a result should show
there: its own picture or, where it shows nothing, emptiness, over which a fit draws several backgrounds.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from gsmerge.arrays import max_columns
from gsmerge.method.raster import TiledView, render
from gsmerge.method.raster.composite import composite, find_covered
from gsmerge.method.raster.images import tile_views, tiles_near
from gsmerge.method.raster.photos import COVERED_TRANSMITTANCE, counting_pixels
from gsmerge.prepare.fill_holes import find_bare, large_parts
from gsmerge.prepare.photo_change import PhotoChange, change_large
from gsmerge.types import PicturedScene

# These radii are in widths of a Gaussian, see measure_unit. Left-out pixels are empty in holes of the input of at least
# the radius HOLE, and in the rim RIM around these holes, where Gaussians of an object reach over its edge. In a view
# with a large empty part that no mask leaves out, as of an object, other holes are empty, too, and photos do not count
# in the next RING widths
HOLE = 3
RIM = 2
RING = 3
SOFT = 1.5  # pixels at the edge of an object before a uniform background, where the photo mixes both
NOISE = np.float32(16 / 255)  # largest difference between the colour of a uniform background and a pixel of it
LEAST_ALIKE = 0.95  # least share of the pixels of a uniform background that differ less
SOLID = 0.95  # opacity of a picture from which on it shows an object, and not Gaussians that reach over its edge


def mask_background(scene: PicturedScene) -> tuple[PicturedScene, str]:
    """Leave out the uniform background of photos of an object, which is where the input shows nothing.

    Also returns a sentence that says so. The pixels get the mean colour of the object. A cropped scene is part of a
    place, of which photos show more.
    """
    if scene.region is not None:
        return scene, ""
    bare = find_bare(scene)
    counts = counting_pixels(scene)
    num_views = 0
    parts = {view: part for view in range(len(scene)) if (part := large_parts(bare[view]) & counts[view]).any()}
    if not parts:
        return scene, ""
    unit = measure_unit(scene)
    counts = counts.copy()
    images = [*scene.images]
    importance = np.ones(counts.shape, np.float32) if scene.importance is None else scene.importance.copy()
    for view, part in parts.items():
        photo = images[view]
        is_alike = max_columns(np.abs(photo - np.median(photo[part], 0))) <= NOISE
        if is_alike[part].mean() >= LEAST_ALIKE:
            # an object of the background's colour is solid; large Gaussians reach over its edge, and are not
            alpha = render(scene.gaussians, scene.cameras[[view]]).alphas[0, ..., 0]
            _, labels = cv2.connectedComponents(is_alike.astype(np.uint8), connectivity=4)
            around = np.isin(labels, labels[part & is_alike]) & _grow(alpha < SOLID, RIM * unit)
            behind = around | (is_alike & bare[view])
            mixed = _grow(behind, SOFT) & ~behind
            counts[view] &= ~(behind | mixed)
            importance[view][mixed & (alpha >= 1 - COVERED_TRANSMITTANCE)] = 0  # neither colour nor alpha is known
            # contrast with a bright background would hide what the object shows where photos are compared
            inner = photo[counts[view]].mean(0) if counts[view].any() else photo[part].mean(0)
            images[view] = np.where(counts[view][..., None], photo, inner)
            num_views += 1
    if not num_views:
        return scene, ""
    change = (
        f"{num_views} of {len(scene)} photos show one colour where the scene shows nothing: it counts as transparent"
    )
    return replace(scene, masks=counts, images=np.stack(images), importance=importance), change


def draw_left_out(scene: PicturedScene, masks: np.ndarray | None) -> PicturedScene:
    """Return a scene whose pictures, where they do not count, show the input, or nothing where the input shows nothing.

    ``masks`` are the masks of the photos, before :func:`fill_holes` left out large empty parts.
    """
    counts = counting_pixels(scene).copy()
    if counts.all() or scene.region is not None:  # a cropped scene is empty beyond its region
        return scene
    unit = measure_unit(scene)
    holes = np.zeros(counts.shape, bool) if scene.empty is None else scene.empty > 0
    outside = np.zeros(counts.shape, bool) if masks is None else ~masks
    # in a view with a hole all is drawn, in others what lies near left-out pixels
    drawn = [view for view in range(len(scene)) if outside[view].any() or holes[view].any()]
    parts = {view: tiles_near(outside[view], 2 * HOLE * unit) for view in drawn if not holes[view].any()}
    bare = np.ones(counts.shape, bool)
    own = scene.has_own_pixels
    # pictures already have the colours of the views' own Gaussians, which are solid
    colors = scene.images.copy() if own else np.zeros_like(scene.images)
    transmittance = np.full(counts.shape, not own, np.float32)

    def draw(view: int, tiled: TiledView) -> None:
        """Draw a view of the input, or find only where the input shows nothing."""
        if own:
            bare[view] = ~find_covered(tiled, float(COVERED_TRANSMITTANCE))
            return
        image, transmittance[view] = composite(tiled)
        colors[view] = image.clip(0, 1)
        bare[view] = transmittance[view] > COVERED_TRANSMITTANCE

    tile_views(scene.gaussians, scene.cameras, draw, drawn, parts)
    solid = ~find_bare(scene) if own else np.zeros_like(bare)
    if scene.beyond is not None:  # nothing is known there
        bare &= ~scene.beyond
        if not own:
            solid = scene.beyond
    for view, hole in enumerate(holes):
        left_out = outside[view]
        nothing = _grow(~_grow(~bare[view], HOLE * unit), HOLE * unit)
        cut = (hole | nothing if hole.any() else hole) & ~left_out
        counts[view] &= ~_grow(cut, RING * unit)
        left_out |= cut
        is_empty = (hole | (_grow(nothing & left_out, RIM * unit) & ~solid[view])) & left_out
        colors[view][is_empty] = 0
        transmittance[view][is_empty] = 1
    changes = [PhotoChange(cover=~counting, colors=picture) for counting, picture in zip(counts, colors, strict=True)]
    images = np.stack([change(photo) for change, photo in zip(changes, scene.images, strict=True)])
    large = None if scene.large_photos is None else change_large(scene.large_photos, changes)
    return replace(scene, images=images, masks=counts, large_photos=large, empty=np.where(counts, 0, transmittance))


def measure_unit(scene: PicturedScene) -> float:
    """Return how many pixels wide a Gaussian in front is in a view, in the median view; at least 1.

    Views may have far more pixels than a model made Gaussians from.
    """
    if scene.has_own_pixels:
        return 1.0
    fronts = [front[front >= 0] for front in scene.get_pixels().fronts]
    widths = [np.sqrt(front.size / np.count_nonzero(np.bincount(front))) for front in fronts if front.size]
    return max(1.0, float(np.median(widths))) if widths else 1.0


def _grow(mask: np.ndarray, radius: float) -> np.ndarray:
    """Grow a mask ``[h,w]`` by ``radius`` pixels."""
    if not mask.any():
        return mask
    distances = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distances <= radius)
