"""Scene with photos -> the scene whose photos follow what was edited in the scene after the photos were taken.

A model takes the colour of a Gaussian from a photo, so the photo of some view has this colour where the view sees the
Gaussian, even if the Gaussian's depth is wrong. Gaussians that were inserted, moved or painted have a colour that no
photo has at their place. If each Gaussian belongs to a pixel, moved Gaussians are no longer seen in their own pixels,
and deleted Gaussians leave pixels without Gaussians. Where a scene was edited, drawings of it replace the photos.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from gsmerge.arrays import distinct, max_columns, mean_columns
from gsmerge.method.compare.view_pictures import fit_size, pair_photos
from gsmerge.method.geometry.transforms import camera_centres, camera_depths, project, sh0_to_rgb
from gsmerge.method.kernels.pictures import convolve
from gsmerge.method.kernels.raster.project import view_colors
from gsmerge.method.raster import render
from gsmerge.method.raster.photos import COVERED_TRANSMITTANCE, counting_pixels, pixel_weights
from gsmerge.prepare.compare_photos import COMPARED_OPACITY, correct_tones
from gsmerge.prepare.photo_change import KEEP, PhotoChange, change_large
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import PicturedScene, Pixels, Scene

LEAST_VIEWS = 3  # of two photos, one alone says whether the other's colours are wrong or its depths
MOST_PAIRS = 400_000  # number of pairs of a sampled Gaussian and a view; comparing their colours takes about 0.1 s
PHOTO_SIDE = 160  # longer side of the photos in which colours are looked up, pixels; with 80, fine texture is lost
SHARE_SIDE = 80  # longer side of the pictures of shares, pixels; few of their pixels have no sampled Gaussian
# Least difference (sRGB, mean of the channels) of a Gaussian, or of a drawing, from a photo. Models blur photos, but
# seldom change colours by more
OTHER = 0.05
FRONT = 1.1  # Gaussians in front are those up to this multiple of the least depth in their pixel of a small picture
# Least share of edited Gaussians among those in front. In sound scenes shares reach 0.15, where depth is wrong; in
# edited scenes they reach at least 0.26, because some photo may have a colour of an inserted object at its place
DENSE = 0.22
NEAR = 4  # around dense ones, shares of an edit are at least this multiple of the share in the whole scene
LEAST_FRONT = 8  # least number of Gaussians in front from which a share is known
LEAST_PART = 0.003  # least share of a picture that an edit covers; smaller parts are dense by chance
# Least distance of a moved Gaussian from its own pixel, in longer sides of a picture. Within it, Gaussians lie beside
# their pixels because poses or lenses are inexact
MOVED = 0.01
# Largest share of Gaussians that were moved or have new colours, of pixels without Gaussians, or of pixels that differ.
# If more are, Gaussians are stored in another order than their pixels, photos have another tone or look, Gaussians are
# rough all over, or the exporter left out what it was not sure of
MOST_EDITED = 0.3
COMPACT = 0.6  # least share of a view's pixels without Gaussians in one part; exporters leave out pixels everywhere
SQUARE_3 = np.ones((3, 3), np.uint8)
SQUARE_5 = np.ones((5, 5), np.uint8)


def follow_edits(scene: Scene) -> tuple[Scene, str]:
    """Replace photos by drawings of the scene where the scene was edited.

    Also returns a sentence that says so. A scene that was not edited is returned as it is, with "".
    """
    if scene.images is None or len(scene.photo_views) < LEAST_VIEWS:
        return scene, ""
    views = scene.photo_views
    pictured = PicturedScene.with_pictures(scene, scene.images, scene.masks)
    step = 1 + len(scene.gaussians) * len(views) // MOST_PAIRS
    rows = np.arange(0, len(scene.gaussians), step)
    edited = _find_moved(pictured, rows) if scene.has_own_pixels else _find_new_colors(pictured, rows)
    if edited.mean() > MOST_EDITED:
        return scene, ""
    shares = _measure_shares(pictured, rows, edited)
    is_dense = _are_dense(shares)
    if is_dense and not scene.has_own_pixels and correct_tones(pictured, pair_photos(pictured, scene.images), views)[1]:
        return scene, ""  # photos of another tone have the colours of no Gaussian
    left = np.zeros(scene.images.shape[:3], bool)  # pixels whose own Gaussians are gone
    unedited = scene
    if is_dense and scene.has_own_pixels:
        pixels, left = _move_homes(pictured)
        scene = replace(scene, pixels=pixels)
    elif scene.has_own_pixels:
        left = _find_deleted(pictured, rows)
    if not is_dense and not left.any():
        return scene, ""
    weak = min(DENSE, NEAR * float(edited.mean()))
    # what was inserted may have been moved, and then it has left another place
    lost = _measure_lost(pictured, rows) if is_dense and not scene.has_own_pixels else []
    drawn = render(scene.gaussians, scene.cameras)
    masks = counting_pixels(scene).copy()
    changes = [PhotoChange()] * len(scene)
    for number, (view, share) in enumerate(zip(views, shares, strict=True)):
        picture = drawn.images[view].clip(0, 1)
        gap = cv2.morphologyEx(left[view].astype(np.uint8), cv2.MORPH_CLOSE, SQUARE_3)
        cover = cv2.dilate(gap, SQUARE_5) > 0  # pixels beside an outline have some of the colour within
        if is_dense:
            cover |= _find_different(share, weak, pictured.images[view], picture)
        if lost:
            weak_lost = min(DENSE, NEAR * float(lost[number].mean()))
            cover |= _find_different(lost[number], weak_lost, pictured.images[view], picture)
        if cover.any():
            changes[view] = PhotoChange(cover=cover, colors=picture)
        is_empty = drawn.alphas[view, ..., 0] < 1 - COVERED_TRANSMITTANCE
        masks[view] &= ~(cover & is_empty)  # or it would be filled from the photo
    images = np.stack([change(photo) for change, photo in zip(changes, pictured.images, strict=True)])
    large = None if scene.large_photos is None else change_large(scene.large_photos, changes)
    covered = sum(int(change.cover.sum()) for change in changes if change.cover is not None)
    if covered > MOST_EDITED * masks.size:
        return unedited, ""
    change = (
        f"the scene was edited after the photos were taken, at {100 * covered / masks.size:.1f} % of their pixels:"
        f" drawings of the scene replace the photos there{KEEP}"
    )
    if scene.masks is not None or not masks.all():
        scene = replace(scene, masks=masks)
    return replace(scene, images=images, large_photos=large), change


def _find_new_colors(scene: PicturedScene, rows: np.ndarray) -> np.ndarray:
    """Find which of the Gaussians ``rows [m]`` have a colour that no photo has at their place, as a mask ``[m]``."""
    width, height = fit_size((scene.cameras.width, scene.cameras.height), PHOTO_SIDE)
    gaussians = scene.gaussians[rows]
    means = gaussians.means
    base_colors = sh0_to_rgb(gaussians.sh0[:, 0]).clip(0, 1).astype(np.float32)
    eyes = camera_centres(scene.cameras.viewmats)
    inside = pixel_weights(scene.masks, width, height)

    def compare(view: int) -> np.ndarray:
        """Return the distance ``[m]`` of each colour from those around its place in a photo; inf for unseen ones."""
        colors = base_colors
        if gaussians.sh_degree:  # harmonics may make up for base colours that are far off
            ids = np.arange(len(rows), dtype=np.int32)
            colors = np.empty_like(base_colors)
            rays = (means - eyes[view]).astype(np.float32)
            view_colors(rays, gaussians.sh0, gaussians.shN, ids, np.zeros(3, np.float32), 0, len(ids), colors)
            colors = colors.clip(0, 1)
        photo = cv2.resize(scene.images[view], (width, height), interpolation=cv2.INTER_AREA)
        seen, places, _ = _look_up(means, scene, view, width, height)
        seen = seen if inside is None else seen & (inside[view].reshape(-1)[places] == 1)
        low = cv2.erode(photo, SQUARE_3).reshape(-1, 3)[places]
        high = cv2.dilate(photo, SQUARE_3).reshape(-1, 3)[places]
        beyond = np.maximum(low - colors, colors - high).clip(0)
        return np.where(seen, mean_columns(beyond), np.float32(np.inf))

    distances = np.stack(parallel_map(compare, scene.photo_views))
    # a Gaussian whose depth is wrong may be seen by one other photo alone, and not by that from which its colour is
    return np.asarray((np.isfinite(distances).sum(0) >= 2) & (distances.min(0) > OTHER))


def _find_moved(scene: PicturedScene, rows: np.ndarray) -> np.ndarray:
    """Find which of the Gaussians ``rows [m]`` are not seen in their own pixels, as a mask ``[m]``.

    No Gaussian counts if too many are not seen there.
    """
    width = scene.cameras.width
    homes, pixels = np.divmod(scene.get_pixels().homes[rows], scene.pixels_per_view)
    centres = np.stack([pixels % width, pixels // width], 1) + 0.5
    least = max(2.0, MOVED * max(width, scene.cameras.height))  # in small pictures rounding counts
    moved = np.zeros(len(rows), bool)
    for view in distinct(homes):
        ids = np.flatnonzero(homes == view)
        (places,), (depths,) = project(scene.gaussians.means[rows[ids]], scene.cameras[[view]])
        distances = max_columns(np.abs(places - centres[ids]))
        moved[ids] = (depths <= 0) | ~(distances < least)  # also where a distance is not a number
    return moved if moved.mean() <= MOST_EDITED else np.zeros_like(moved)


def _move_homes(scene: PicturedScene) -> tuple[Pixels, np.ndarray]:
    """Give Gaussians that have moved the pixels where their views see them now.

    Also returns a mask ``[v,h,w]`` of the pixels that they have left.
    """
    means = scene.gaussians.means
    moved = _find_moved(scene, np.arange(len(means)))
    homes = scene.get_pixels().homes.copy()
    fronts = scene.get_pixels().fronts.copy()
    left = np.zeros(fronts.shape, bool)
    left.reshape(-1)[homes[moved]] = True
    fronts[(fronts >= 0) & moved[fronts]] = -1
    for view in distinct(homes[moved] // scene.pixels_per_view):
        rows = np.flatnonzero(moved & (homes // scene.pixels_per_view == view))
        seen, places, depths = _look_up(means[rows], scene, view, scene.cameras.width, scene.cameras.height)
        nearest_last = np.flatnonzero(seen)
        nearest_last = nearest_last[np.argsort(-depths[nearest_last], kind="stable")]
        rows = rows[nearest_last]
        places = places[nearest_last]
        homes[rows] = places + view * scene.pixels_per_view
        front = fronts[view].reshape(-1)
        other_depths = camera_depths(means[front[places]].astype(np.float64), scene.cameras.viewmats[view])
        is_front = (front[places] < 0) | (depths[nearest_last] < other_depths)
        front[places[is_front]] = rows[is_front]
    return Pixels(homes, fronts, own=True), left


def _find_deleted(scene: PicturedScene, rows: np.ndarray) -> np.ndarray:
    """Find the pixels ``[v,h,w]`` whose Gaussians were deleted.

    In most views, the pixels without Gaussians form one compact part inside of the picture, and none of the Gaussians
    ``rows`` that are seen there has the photo's colours. An exporter leaves out Gaussians, too, but at many places, or
    up to the border. Masked pixels may have no Gaussians.
    """
    bare = ~scene.get_pixels().shown & counting_pixels(scene)
    deleted = np.zeros_like(bare)
    if bare.mean() > MOST_EDITED:
        return deleted
    width, height = fit_size((scene.cameras.width, scene.cameras.height), SHARE_SIDE)
    means = scene.gaussians.means[rows]
    colors = sh0_to_rgb(scene.gaussians.sh0[rows, 0]).clip(0, 1).astype(np.float32)
    num_sure = 0
    for view in scene.photo_views:
        if bare[view].mean() < LEAST_PART:
            continue
        closed = cv2.morphologyEx(bare[view].astype(np.uint8), cv2.MORPH_CLOSE, SQUARE_5)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
        part = labels == 1 + stats[1:, cv2.CC_STAT_AREA].argmax()  # the largest one; 0 is the background
        if (part & bare[view]).sum() < COMPACT * bare[view].sum():
            continue
        deleted[view] = part
        if part[[0, -1]].any() or part[:, [0, -1]].any():
            continue
        photo = cv2.resize(scene.images[view], (width, height), interpolation=cv2.INTER_NEAREST).reshape(-1, 3)
        seen, places, _ = _look_up(means, scene, view, width, height)
        distances = mean_columns(np.abs(colors[seen] - photo[places[seen]]))
        least = np.ones(width * height, np.float32)
        np.minimum.at(least, places[seen], distances)
        small = cv2.resize(part.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST).reshape(-1) > 0
        num_sure += bool(small.any() and (least[small] > OTHER).mean() > DENSE)
    return deleted if 2 * num_sure > len(scene.photo_views) else np.zeros_like(deleted)


def _measure_shares(scene: PicturedScene, rows: np.ndarray, edited: np.ndarray) -> list[np.ndarray]:
    """Return the share of ``edited [m]`` Gaussians among the Gaussians ``rows [m]`` in front.

    There is a small picture ``[h,w]`` for each photo, of windows of 5 x 5 of its pixels. All shares are 0 if too few
    Gaussians are edited for any large part.
    """
    width, height = fit_size((scene.cameras.width, scene.cameras.height), SHARE_SIDE)
    if edited.mean() < DENSE * LEAST_PART:
        return [np.zeros((height, width), np.float32) for _ in scene.photo_views]
    solid = scene.gaussians.opacities[rows] > COMPARED_OPACITY
    window = np.ones(5, np.float32)

    def measure(view: int) -> np.ndarray:
        """Return the shares in one view."""
        seen, places, depths = _look_up(scene.gaussians.means[rows], scene, view, width, height)
        ids = np.flatnonzero(seen & solid)
        nearest = np.full(width * height, np.inf)
        np.minimum.at(nearest, places[ids], depths[ids])
        ids = ids[depths[ids] < FRONT * nearest[places[ids]]]
        counts = [np.bincount(places[some], minlength=width * height) for some in (ids, ids[edited[ids]])]
        number, found = (convolve(count.reshape(height, width), window, window) for count in counts)
        return found / np.maximum(number, LEAST_FRONT)

    return parallel_map(measure, scene.photo_views)


def _measure_lost(scene: PicturedScene, rows: np.ndarray) -> list[np.ndarray]:
    """Return the share of pixels whose colour none of the Gaussians ``rows [m]`` near them has, as where one was moved.

    There is a small picture ``[h,w]`` for each photo, of windows of 7 x 7 of its pixels, without parts that reach the
    border. The list is empty if less than half of the photos have a large part. Exporters leave out Gaussians as well,
    so this tells an edit only in a scene that was edited elsewhere.
    """
    size = fit_size((scene.cameras.width, scene.cameras.height), SHARE_SIDE)
    width, height = size
    means = scene.gaussians.means[rows]
    colors = sh0_to_rgb(scene.gaussians.sh0[rows, 0]).clip(0, 1).astype(np.float32)
    counting = counting_pixels(scene)
    window = np.full(7, 1 / 7, np.float32)

    def measure(view: int) -> np.ndarray:
        """Return the shares in one view."""
        photo = cv2.resize(scene.images[view], size, interpolation=cv2.INTER_AREA)
        seen, places, _ = _look_up(means, scene, view, width, height)
        down, across = np.divmod(places[seen], width)
        own = colors[seen]
        lost = cv2.resize(counting[view].astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        for step_down in (-1, 0, 1):
            for step_across in (-1, 0, 1):
                line = (down + step_down).clip(0, height - 1)
                column = (across + step_across).clip(0, width - 1)
                is_same = mean_columns(np.abs(own - photo[line, column])) < OTHER
                lost[line[is_same], column[is_same]] = False
        share = convolve(lost.astype(np.float32), window, window)
        _, labels = cv2.connectedComponents((share > DENSE).astype(np.uint8), connectivity=8)
        border = np.concatenate([labels[[0, -1]].ravel(), labels[:, [0, -1]].ravel()])
        return np.where((labels > 0) & np.isin(labels, border), 0, share)

    shares = parallel_map(measure, scene.photo_views)
    return shares if _are_dense(shares) else []


def _are_dense(shares: Sequence[np.ndarray]) -> bool:
    """Return whether shares ``[h,w]`` are dense in a large part of at least half of the photos."""
    return 2 * sum(bool(_find_large(share > DENSE).any()) for share in shares) >= len(shares)


def _find_large(mask: np.ndarray) -> np.ndarray:
    """Find the pixels ``[h,w]`` of the connected parts of a mask that are large enough for an edit."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    is_large = stats[:, cv2.CC_STAT_AREA] >= LEAST_PART * mask.size
    is_large[0] = False  # pixels beside the mask
    return is_large[labels]


def _find_different(share: np.ndarray, weak: float, photo: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """Find the pixels ``[h,w]`` at which the photo differs from a drawing ``picture`` because the scene was edited.

    These are connected parts of different pixels that reach from where the ``share`` of edited Gaussians, a small
    picture, is dense to where it is still more than ``weak``.
    """
    size = photo.shape[1::-1]
    core = cv2.morphologyEx(_find_large(share > DENSE).astype(np.uint8), cv2.MORPH_CLOSE, SQUARE_5)
    around = core | _find_large(share > weak)
    # a small pixel more on each side, because photos and drawings are sharper
    is_dense = cv2.resize(cv2.dilate(core, SQUARE_3), size, interpolation=cv2.INTER_NEAREST) > 0
    is_near = cv2.resize(cv2.dilate(around, SQUARE_3), size, interpolation=cv2.INTER_NEAREST) > 0
    mean = np.full(3, 1 / 3, np.float32)
    differs = is_near & (convolve(mean_columns(np.abs(picture - photo)), mean, mean) > OTHER)
    _, labels = cv2.connectedComponents(differs.astype(np.uint8), connectivity=4)
    cover = np.isin(labels, labels[is_dense & differs]).astype(np.uint8)
    # what is left of single pixels goes, and gaps where colours are alike by chance are closed
    opened = cv2.morphologyEx(cover, cv2.MORPH_OPEN, SQUARE_3)
    closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8))
    return (cv2.dilate(closed, SQUARE_3) > 0) & is_near


def _look_up(
    points: np.ndarray, scene: PicturedScene, view: int, width: int, height: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Look up points ``[m,3]`` in a picture of a view with ``width`` x ``height`` pixels.

    Returns which points are in the picture, the pixel of each, ``y·width + x`` or 0, and its depth, all ``[m]``.
    """
    (places,), (depths,) = project(points, scene.cameras[[view]])
    zoom = np.array([width / scene.cameras.width, height / scene.cameras.height])
    columns, lines = np.floor(np.nan_to_num(places * zoom, nan=-1, posinf=-1, neginf=-1)).T
    seen = (depths > 0) & (columns >= 0) & (columns < width) & (lines >= 0) & (lines < height)
    return seen, np.where(seen, lines * width + columns, 0).astype(int), depths
