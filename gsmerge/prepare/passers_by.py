"""Scene with photos -> the scene without what only one photo shows, such as somebody who walks through.

The other views see through the Gaussians of a passer-by. What they see behind has the same colour in all of them, and
no other view shows the colour of the photo there. Where only the depth of a view is wrong, other views show the same
colour as the photo. All is compared on small photos.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from gsmerge.arrays import mean_columns
from gsmerge.frozen import dataclass, replace
from gsmerge.method.compare.view_pictures import fit_size
from gsmerge.method.geometry.transforms import camera_depths, median, nearest_views, project
from gsmerge.method.geometry.views import even_views, resize_cameras, take_rows
from gsmerge.method.raster.photos import counting_pixels
from gsmerge.prepare.photo_change import KEEP
from gsmerge.prepare.surfaces import SAME_LOG_DEPTH
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, PicturedScene, Scene

NEIGHBORS = 4  # nearest other views that are asked: two that see through a passer-by, and two whose view it may hide
QUICK_VIEWS = 8  # views that are searched first; if they show no passer-by, other views are not searched
SMALL_SIDE = 80  # longer side of small photos, pixels: a pixel is wider than the usual errors of projected positions
SAME_DEPTH = 1 + SAME_LOG_DEPTH  # quotient of two depths of one surface
THROUGH = 1 + 2 * SAME_LOG_DEPTH  # quotient of depths from which on a view sees through the nearer surface
FAR = 4.0  # depths above this multiple of the view's median are guessed by models, such as that of the sky
NOISE = 0.05  # mean difference of the channels, sRGB in [0, 1], of one surface in small photos of two views
OTHER = 2.0  # the photo differs if it is this many times as far from the other views' mean as they are on average
LEAST_PART = 0.01  # least share of a photo; edges at which depths are wrong make smaller parts
EDGE = 2.5 * NOISE  # contrast within 5 x 5 small pixels from which on a pixel is near an edge
# Least share of a part near edges: smooth surfaces, whose depths models guess, have up to 0.59, and 95 % of people more
NEAR_EDGES = 0.6
NO_COLOR = np.float32(2)  # stands for the colour of nothing, and differs from all colours
SQUARE_3 = np.ones((3, 3), np.uint8)
SQUARE_5 = np.ones((5, 5), np.uint8)
REACH = np.ones((17, 17), np.uint8)  # pixels within 8, a tenth of the longer side, may belong to the part beside them


@dataclass(frozen=True, eq=False)
class SmallView:
    """A photo of h x w pixels on the longer side of at most :data:`SMALL_SIDE`, and the Gaussians of its pixels."""

    camera: Cameras  # One camera
    photo: np.ndarray  # [h,w,3] sRGB in [0, 1]
    known: np.ndarray  # [h,w] bool, pixels that count and have a Gaussian
    means: np.ndarray  # [h,w,3] float64, world units; anything in pixels that are not known
    depths: np.ndarray  # [h,w] world units
    least_depths: np.ndarray  # [h,w] float32, least known depth within 3 x 3 pixels, inf for none


def leave_out_passers(scene: Scene) -> tuple[Scene, np.ndarray | None, str]:
    """Leave out what only one photo shows, and its Gaussians.

    Also returns a mask ``[v,h,w]`` of these pixels, None if there are none, and a sentence.
    """
    views = scene.photo_views
    if scene.images is None or not scene.has_own_pixels or len(views) < NEIGHBORS:
        return scene, None, ""
    pictured = PicturedScene.with_pictures(scene, scene.images, scene.masks)
    quick = [views[i] for i in even_views(len(views), min(len(views), QUICK_VIEWS))]
    parts = _find_parts(pictured, quick)
    if not any(part.any() for part in parts.values()):
        return scene, None, ""
    parts |= _find_parts(pictured, [view for view in views if view not in parts])
    counting = counting_pixels(scene)
    gone = np.zeros_like(counting)
    height, width = counting.shape[1:]
    for view, part in parts.items():
        large = cv2.resize(part.astype(np.uint8), (width, height), interpolation=cv2.INTER_LINEAR_EXACT)
        gone[view] = cv2.dilate(large, SQUARE_3) > 0
    rows = gone.reshape(-1)[scene.get_pixels().homes]
    count = int(gone.any((1, 2)).sum())
    change = (
        f"{count} of {len(views)} photos show something that is in no other, at {100 * gone.mean():.1f} % of all"
        f" pixels, perhaps people or things that moved: it is left out with its Gaussians{KEEP}"
    )
    return take_rows(replace(scene, masks=counting & ~gone), np.flatnonzero(~rows)), gone, change


def _find_parts(scene: PicturedScene, views: Sequence[int]) -> dict[int, np.ndarray]:
    """Find the pixels ``[h,w]`` of the small photos of ``views`` that show something that is in no other photo."""
    photo_views = {*scene.photo_views}
    neighbors = dict[int, list[int]]()
    for view in views:
        others = [other for other in nearest_views(scene.cameras.centres, view).tolist() if other in photo_views]
        neighbors[view] = others[:NEIGHBORS]
    needed = sorted({*views, *(other for others in neighbors.values() for other in others)})
    small = dict(zip(needed, parallel_map(lambda view: _shrink(scene, view), needed), strict=True))
    parts = parallel_map(lambda view: _find_part(small[view], [small[other] for other in neighbors[view]]), views)
    return dict(zip(views, parts, strict=True))


def _shrink(scene: PicturedScene, view: int) -> SmallView:
    """Return a view with a small photo, whose pixels have the Gaussians of the pixels at their centres."""
    cameras = scene.cameras
    width, height = fit_size((cameras.width, cameras.height), SMALL_SIDE)
    columns = (2 * np.arange(width) + 1) * cameras.width // (2 * width)
    lines = (2 * np.arange(height)[:, None] + 1) * cameras.height // (2 * height)
    rows = scene.get_pixels().fronts[view, lines, columns]
    known = rows >= 0
    if scene.masks is not None:
        known &= scene.masks[view, lines, columns]
    means = scene.gaussians.means[np.maximum(rows, 0)].astype(np.float64)
    depths = camera_depths(means, cameras.viewmats[view])
    return SmallView(
        camera=resize_cameras(cameras[[view]], width, height),
        photo=cv2.resize(scene.images[view], (width, height), interpolation=cv2.INTER_AREA),
        known=known,
        means=means,
        depths=depths,
        least_depths=cv2.erode(np.where(known, depths, np.inf).astype(np.float32), SQUARE_3),
    )


def _look_up(view: SmallView, means: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the pixels of a view in which points ``[h,w,3]`` lie.

    Returns the ids ``[k]`` of the points inside the picture, and the pixels ``[k]`` and depths ``[k]`` of these points.
    """
    (places,), (depths,) = project(means.reshape(-1, 3), view.camera)
    height, width = view.known.shape
    x, y = places.T
    ids = np.flatnonzero((depths > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height))
    return ids, y[ids].astype(np.int64) * width + x[ids].astype(np.int64), depths[ids]


def _find_part(own: SmallView, others: Sequence[SmallView]) -> np.ndarray:
    """Find the pixels ``[h,w]`` of a photo that show something that is in none of the photos of other views."""
    seen_through, differs = _compare(own, others)
    differs = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_CLOSE, SQUARE_3)
    differs = cv2.morphologyEx(differs, cv2.MORPH_OPEN, SQUARE_3)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(differs, connectivity=8)
    contrast = mean_columns(cv2.dilate(own.photo, SQUARE_5) - cv2.erode(own.photo, SQUARE_5))
    areas = stats[:, cv2.CC_STAT_AREA]
    near_edges = np.bincount(labels[contrast > EDGE], minlength=len(areas))
    is_thing = (areas >= LEAST_PART * differs.size) & (near_edges >= NEAR_EDGES * areas)
    is_thing[0] = False  # the pixels that are in no part
    core = is_thing[labels]
    # other photos may have the colours of some pixels of the thing, so pixels near its core belong to it if other
    # views see through them
    near = cv2.dilate(core.astype(np.uint8), REACH) > 0
    _, labels = cv2.connectedComponents((core | (seen_through & near)).astype(np.uint8), connectivity=4)
    whole = np.isin(labels, labels[core])
    return np.asarray(cv2.morphologyEx(whole.astype(np.uint8), cv2.MORPH_CLOSE, SQUARE_5) > 0)


def _compare(own: SmallView, others: Sequence[SmallView]) -> tuple[np.ndarray, np.ndarray]:
    """Compare a photo with what other views see in its pixels.

    Returns two masks ``[h,w]``: pixels whose Gaussians other views see through, and those of them at which the other
    views agree on a colour behind, which the photo does not have, and at which none has the colour of the photo.
    """
    shape = own.known.shape
    num_through = np.zeros(own.known.size, np.int64)
    num_same = np.zeros(own.known.size, np.int64)
    for other in others:
        ids, pixels, depths = _look_up(other, own.means)
        inside = own.known.reshape(-1)[ids] & other.known.reshape(-1)[pixels]
        # through the pixels around as well, because a view sees by chance past the silhouette of a thing
        num_through[ids] += inside & (other.least_depths.reshape(-1)[pixels] > THROUGH * depths)
        surface = other.depths.reshape(-1)[pixels]
        num_same[ids] += inside & (surface < SAME_DEPTH * depths) & (depths < SAME_DEPTH * surface)
    seen_through = own.known & ((num_through >= 2) & (num_through > 2 * num_same)).reshape(shape)
    if seen_through.mean() < LEAST_PART:  # as in most views without a passer-by
        return seen_through, np.zeros_like(seen_through)
    pictures = np.full((len(others), *shape, 3), NO_COLOR)  # what each other view shows in the pixels of the photo
    layers = np.zeros((len(others), *shape))  # depths in the photo's camera of what is shown; 0 for nothing
    for other, picture, layer in zip(others, pictures, layers, strict=True):
        ids, pixels, depths = _look_up(own, other.means)
        order = np.argsort(-depths, kind="stable")  # the nearest is last, and hides what is behind
        order = order[other.known.reshape(-1)[ids[order]]]
        picture.reshape(-1, 3)[pixels[order]] = other.photo.reshape(-1, 3)[ids[order]]
        layer.reshape(-1)[pixels[order]] = depths[order]
    # only the views that see the farthest surface, because passers-by may hide it from the other views
    shows = (layers > 0) & (layers * THROUGH * THROUGH > layers.max(0)) & (layers < FAR * median(own.depths[own.known]))
    count = shows.sum(0)
    mean = (pictures * shows[..., None]).sum(0) / np.maximum(count, 1)[..., None]
    spread = (mean_columns(np.abs(pictures - mean)) * shows).sum(0) / np.maximum(count, 1)
    agree = (count >= 2) & (2 * count > (layers > 0).sum(0))
    differs = seen_through & agree & (mean_columns(np.abs(own.photo - mean)) > OTHER * spread + NOISE)
    # no view shows the photo's colour, at whatever depth, also not beside the pixel, where wrong depths may put it
    lines, columns = np.nonzero(differs)
    beside = np.arange(3)
    framed = np.pad(pictures, ((0, 0), (1, 1), (1, 1), (0, 0)), constant_values=NO_COLOR)
    around = framed[:, lines[:, None, None] + beside[:, None], columns[:, None, None] + beside]
    colors = own.photo[lines, columns][:, None, None]
    differs[lines, columns] = ~(mean_columns(np.abs(around - colors)) < NOISE).any((0, 2, 3))
    return seen_through, differs
