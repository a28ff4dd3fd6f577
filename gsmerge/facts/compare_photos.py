"""Scene -> the same with photos that look as its Gaussians, without those that do not show it.

Photos with red and blue in the wrong order and of another tone (linear light, exposure, gamma: a curve for each
channel) are mended. Where a photo then still differs from what the Gaussians of its own pixels show, whatever their
depths are, their colours count: something covers the scene there, or the photo is of another view, or black. Gaussians
without pixels are drawn; wrong depth displaces drawings, so of their photos those without the scene's edges are left
out as a whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from gsmerge.facts.photo_change import PhotoChange, change_large, look_up
from gsmerge.facts.row_colors import RowPicture, fill_gaps, picture_rows
from gsmerge.geometry import sh0_to_rgb
from gsmerge.kernels.elementary import log
from gsmerge.kernels.matrices import matmul, solve
from gsmerge.kernels.pictures import convolve
from gsmerge.raster import render
from gsmerge.raster.images import thin_out
from gsmerge.raster.photos import blank_photos, photo_errors, photos_of, pixel_weights, row_pictures, shrink_pictures
from gsmerge.runtime.record import adopt, choose, note, record_part
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.stages import Look
from gsmerge.types import PicturedScene

# Differences are of colours in [0, 1]. Of 15 captures the photos differ from their pixels' own colours by 0.003 in the
# median, and from drawings by 0.01 to 0.2; the order of the channels raises that by 8 % at the least.
# Differences are averaged over 5 pixels, with their signs. A blur of 1.5 pixels, as models have, makes 0.5 % of the
# pixels of five captures differ; the photo of another view 28 to 53 %.
WINDOW = np.full(5, 1 / 5, np.float32)
FAINT = 0.05  # opacity below which a pixel's Gaussian is not compared
FAR = 0.06  # such a difference from which on the Gaussians' colours count
# Share of a photo's pixels that differ, from which on it does not show the scene; the same of those that are not of one
# colour, as masks and bands are: 0.28 to 0.53 of the photos of other views.
OTHER, OTHER_TEXTURED = 0.75, 0.25
SAME = 2.5 / 255  # range of one colour
SIDE, DRAWN_SIDE, EDGES_SIDE = 192, 96, 48  # pixels of the longer side for tones, the same of drawings, and for edges
SAMPLES = 1 << 17  # Gaussians that are drawn
SWAPPED, MIN_SWAP = 0.75, 0.01  # difference with channels reversed, of that without; and by how much it is less
LEVELS = 33  # quantiles that a tone curve joins
MIN_TONE, MIN_TONE_DRAWN = 0.03, 0.08  # median change of the colours from which on a tone is compensated
CLEAR_TONE = 0.05  # the same of one photo at least, where Gaussians have pixels
EXPLAINED, EXPLAINED_DRAWN = 0.5, 0.6  # most of the difference that the curve may leave
# Of drawings: right photos reach correlations of 0.13 to 0.8; noise mostly stays below 0.06, photos of other views
# below 0.3.
MIN_PIXELS = 64  # of a small picture
FLAT = 1 / 255  # root mean square of a view's gradients: below it a view shows nothing to go by
LEAST, SHARE = 0.06, 0.25  # least correlation of a photo that shows the scene, and of the median of all photos
GAIN = 0.4  # of the inverse hyperbolic tangent of the correlation: more with another view, and the photo is of that one
CLOSEST = 0.995  # correlation above which photos are equally good
NAMED = 4  # views that a note names
STRAY_PHOTOS = "photos do not show what the Gaussians show"  # in the note on photos that are not used
# Correlation of edges, chosen on twelve looks of three captures: .57 to .99, or with colours by depth .13 to .41 and .1
# above that with other views; that is -.05 to .33
LOOK_SIDE, OWN_EDGES, MORE_EDGES = 96, 0.5, 0.1
# Errors of a linear map as a share of those of tones, in the median and in the root mean square: one or the other is
# .86 or more with photos of 15 captures and with mild grades, both are .17 to .76 with styles
COARSE_SIDE, OPAQUE, RECOLORED = 12, 0.7, 0.8
UNEXPLAINED = 0.6  # error of the map, of the spread of colours: more with photos of another scene
ALIKE = 0.015  # root mean square error of tones up to which nothing is to be explained


@dataclass(frozen=True, eq=False)
class Shown:
    """Small pictures of each photo and of the Gaussians from the same camera."""

    photos: np.ndarray  # [v,h,w,3]
    pictures: np.ndarray  # [v,h,w,3]
    weights: np.ndarray  # [v,h,w] how much of a pixel the Gaussians show; 0 outside the masks
    drawn: bool  # whether the pictures are drawings, which wrong depth displaces

    def pairs(self, views: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return colours ``[n,3]`` of photos, and of the Gaussians, at pixels where these are opaque enough."""
        counts = self.weights[views] > (0.5 if self.drawn else 0.05)
        return self.photos[views][counts], self.pictures[views][counts]


def compare_photos(scene: PicturedScene, look: Look = "auto") -> tuple[PicturedScene, tuple[int, ...]]:
    """Mend the photos of a canonical scene, and replace what does not show it.

    Returns the scene and the views whose photos show it; there are none if most photos do not, or have another look.
    With ``look`` "photos" all count as they are, with "scene" none. The record gets notes and the choices
    ``photos_changed`` and ``photos_left_out``.
    """
    if look != "auto":
        return scene, tuple(scene.photo_views) if look == "photos" else ()
    small, names = show_photos(scene), scene.names
    given = scene.photo_views
    absent = sorted({*range(len(scene))} - {*given})
    if is_recolored(small):
        return _keep_look(scene)
    with record_part(silent=True) as tones:
        changes = find_tones(small, names)
    if scene.aligned:
        covers, pictures = _find_covers(scene, changes)
        odd = [view for view in range(len(scene)) if _is_other(scene.images[view], covers[view])]
        if 2 * len(odd) > len(scene) and share_edges(small):
            return _keep_look(scene)
    else:
        covers, pictures = np.zeros(scene.images.shape[:3], bool), None
        odd = odd_photos(_mend_small(small, changes))
    adopt(tones)
    odd = [view for view in odd if view not in absent]
    covered = [view for view in given if covers[view].any() and view not in odd]
    changed = sorted({*covered, *(view for view, change in enumerate(changes) if change)} - {*odd})
    if changed:
        choose(photos_changed=[names[view] for view in changed])
    if covered:
        most = 100 * max(float(covers[view].mean()) for view in covered)
        note(
            f"{len(covered)} of {len(scene)} photos show in part what their Gaussians do not (up to {most:.0f} % of a"
            " photo: a mask, a mark, a finger, another look or camera?): the Gaussians' colours take its place,"
            f" --set look=scene everywhere: {list_names(names, covered)}"
        )
    if odd and not _leave_out(scene, odd):
        return scene, ()
    covers[[*odd, *absent]] = True
    if scene.masks is not None:
        covers |= ~scene.masks
    if absent and scene.masks is not None:  # what stands in for their photos counts
        masks = scene.masks.copy()
        masks[absent] = True
        scene = replace(scene, masks=None if masks.all() else masks)
    return _change(scene, changes, covers, pictures), tuple(view for view in given if view not in odd)


def _keep_look(scene: PicturedScene) -> tuple[PicturedScene, tuple[int, ...]]:
    """Note that no photo counts, since the scene has another look; return what :func:`compare_photos` does then."""
    problem = "the scene has another look than its photos: its own colours are kept"
    note(f"{problem}; --set look=photos gives it that of the photos")
    return scene, ()


def _is_other(photo: np.ndarray, cover: np.ndarray) -> bool:
    """Return whether so much of a photo ``[h,w,3]`` differs that it shows something else, or black."""
    if cover.mean() <= OTHER_TEXTURED:
        return False
    square = np.ones((3, 3), np.uint8)
    spread = _over_channels(np.maximum, cv2.dilate(photo, square) - cv2.erode(photo, square))
    return bool(cover.mean() > OTHER or (cover & (spread > SAME)).mean() > OTHER_TEXTURED)


def _leave_out(scene: PicturedScene, odd: Sequence[int]) -> bool:
    """Note which photos do not show the scene; return whether the others are used."""
    choose(photos_left_out=[scene.names[view] for view in odd])
    few, which = 2 * len(odd) <= len(scene), list_names(scene.names, odd)
    result = f" and are not used: {which}" if few else f", so none is used: {which}; check their names and order"
    note(f"{len(odd)} of {len(scene)} {STRAY_PHOTOS}{result}")
    return few


def _change(
    scene: PicturedScene, changes: Sequence[PhotoChange], covers: np.ndarray, pictures: np.ndarray | None
) -> PicturedScene:
    """Change photos at both sizes; where ``covers [v,h,w]`` they become ``pictures [v,h,w,3]``, None: drawings."""
    covered = np.flatnonzero(covers.any((1, 2)))
    if len(covered) == 0 and not any(changes):
        return scene
    changes = list(changes)
    if len(covered):
        drawn = (
            render(scene.gaussians, scene.cameras[covered]).images.clip(0, 1) if pictures is None else pictures[covered]
        )
        for view, colors in zip(covered, drawn, strict=True):
            changes[view] = replace(changes[view], cover=covers[view], colors=colors)
    images = np.stack([change(photo) for change, photo in zip(changes, scene.images, strict=True)])
    large = None if scene.large_photos is None else change_large(scene.large_photos, changes)
    return replace(scene, images=images, large_photos=large)


def _find_covers(scene: PicturedScene, changes: Sequence[PhotoChange]) -> tuple[np.ndarray, np.ndarray]:
    """Find the pixels ``[v,h,w]`` where changed photos differ from their own rows, and what these show ``[v,h,w,3]``.

    Pixels without a row are as the nearest with one. Only where the rows' base colours differ are each view's own
    Gaussians drawn from its camera, which takes longer; a photo that looks as the drawing does not differ.
    """

    def differ(view: int, picture: np.ndarray, known: np.ndarray) -> np.ndarray:
        weights = known.astype(np.float32)
        away = (changes[view](scene.images[view]) - picture) * weights[..., None]
        sums = _over_channels(np.add, np.abs(convolve(away, WINDOW, WINDOW))) / 3
        far = known & (sums > FAR * convolve(weights, WINDOW, WINDOW))
        return fill_gaps(far[..., None], known)[..., 0]

    def differ_drawn(views: np.ndarray, rows: RowPicture) -> None:
        for view in views:
            known = scene.stored[view] & inside[view] & rows.known  # what spills over from beside says nothing
            pictures[view] = rows.picture
            covers[view] = differ(view, rows.picture, known) & differ(view, rows.drawing, known)

    inside = np.full(scene.images.shape[:3], True) if scene.masks is None else scene.masks
    pictures = row_pictures(scene)
    known = scene.stored & (scene.gaussians.opacities.reshape(inside.shape) > FAINT) & inside
    covers = np.stack(parallel_map(lambda view: differ(view, pictures[view], known[view]), range(len(scene))))
    picture_rows(scene, differ_drawn, np.asarray((covers | ~inside).any((1, 2))))
    return covers, pictures


def find_tones(shown: Shown, names: Sequence[str]) -> list[PhotoChange]:
    """Find in which photos red and blue change places, and tone curves; add notes about them."""
    views, none = range(len(shown.photos)), PhotoChange()
    changes = [none] * len(views)
    if _is_reversed(shown, views):
        note("red and blue are in the wrong order in the photos (BGR): they change places")
        changes = [replace(none, reversed=True)] * len(views)
        shown = _mend_small(shown, changes)
    odd = [view for view in views if _is_reversed_alone(shown, view)]
    if odd:
        which = list_names(names, odd)
        note(f"red and blue are in another order in {len(odd)} of {len(views)} photos: they change places: {which}")
        changes = [replace(change, reversed=change.reversed != (view in odd)) for view, change in enumerate(changes)]
    shown = _mend_small(shown, changes)
    curves = _find_curves(shown)
    toned = [view for view in views if curves[view] is not None]
    if toned:
        middle = [float(curves[view][:, 128].mean()) / (128 / 255) for view in toned]  # type: ignore[index]
        least, most = min(middle), max(middle)
        factor = f"{least:.2f}" if most - least < 0.01 else f"{least:.2f} to {most:.2f}"
        note(
            f"{len(toned)} of {len(views)} photos have another tone than their Gaussians (exposure, gamma or linear"
            f" light): compensated, middle grey times {factor}: {list_names(names, toned)}"
        )
    return [replace(change, tones=curve) for change, curve in zip(changes, curves, strict=True)]


def list_names(names: Sequence[str], views: Sequence[int]) -> str:
    """List the names of views for a message, shortened if there are many."""
    more = f" and {len(views) - NAMED} more" if len(views) > NAMED else ""
    return ", ".join(names[view] for view in views[:NAMED]) + more


def show_photos(scene: PicturedScene) -> Shown:
    """Make small pictures of the photos of a canonical scene, and of what the Gaussians show there."""
    longer = max(scene.cameras.width, scene.cameras.height)
    if scene.aligned:  # pixels are compared with their own rows: some of them will do
        step = -(-longer // SIDE)
        some = slice(None), slice(None, None, step), slice(None, None, step)
        opacities, colors = scene.gaussians.opacities, scene.gaussians.sh0.reshape(*scene.images.shape)
        weights = np.where(scene.valid, opacities.reshape(scene.valid.shape), 0)[some]
        if scene.masks is not None:
            weights = weights * scene.masks[some]
        photos, pictures = scene.images[some], sh0_to_rgb(colors[some]).clip(0, 1)
        return Shown(photos, pictures, weights, drawn=False)
    level = max(1.0, longer / DRAWN_SIDE)
    few, blank = thin_out(scene.gaussians, SAMPLES), blank_photos(scene.cameras, level)
    drawn = photo_errors(few, blank, lambda _, image, left: (_divide(image, 1 - left), 1 - left))
    pictures, weights = map(np.stack, zip(*drawn, strict=True))
    inside = pixel_weights(scene.masks, blank.width, blank.height)
    weights = weights if inside is None else weights * (inside == 1)
    return Shown(photos_of(scene.images, scene.cameras, level).images, pictures, weights, drawn=True)


def _divide(image: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """Return the colours of what a drawing ``[h,w,3]`` shows, whatever its ``opacity [h,w]`` is; 0 where it is none."""
    return np.asarray((image / np.maximum(opacity, FAINT)[..., None]).clip(0, 1))


def _mend_small(shown: Shown, changes: Sequence[PhotoChange]) -> Shown:
    """Change the small photos."""
    if not any(changes):
        return shown
    photos = [change(photo) for change, photo in zip(changes, shown.photos, strict=True)]
    return replace(shown, photos=np.stack(photos))


def _difference(colors: np.ndarray, others: np.ndarray) -> float:
    """Return the median difference of colours ``[n,3]``; 0 without any."""
    return float(np.median(_over_channels(np.add, np.abs(colors - others)) / 3)) if len(colors) else 0.0


def _over_channels(combine: np.ufunc, image: np.ndarray) -> np.ndarray:
    """Combine the three channels ``[...,3]`` of a picture, faster than a reduction over so short an axis."""
    return np.asarray(combine(combine(image[..., 0], image[..., 1]), image[..., 2]))


def _is_reversed(shown: Shown, views: Sequence[int]) -> bool:
    """Return whether photos together are nearer to their Gaussians with red and blue exchanged."""
    photos, pictures = shown.pairs(list(views))
    rgb, bgr = _difference(photos, pictures), _difference(photos[:, ::-1], pictures)
    return bgr < SWAPPED * rgb and rgb - bgr > MIN_SWAP


def _is_reversed_alone(shown: Shown, view: int) -> bool:
    """Return whether red and blue are exchanged in one photo: red less blue falls where that of its Gaussians rises."""
    if not _is_reversed(shown, [view]):
        return False
    # No change of tone has this effect
    photo, picture = (colors[:, 0] - colors[:, 2] for colors in shown.pairs([view]))
    return bool(((photo - np.median(photo)) * (picture - np.median(picture))).sum() < 0)


def _find_curves(shown: Shown) -> list[np.ndarray | None]:
    """Find the tone curves ``[3,256]`` from each photo to its Gaussians; None for a photo whose tone is right.

    Drawn scenes have one curve for all photos. Small changes count only if some photo needs a clear one, since models
    have a tone of their own.
    """
    views = range(len(shown.photos))
    if shown.drawn:
        return [_find_curve(shown, views)[0]] * len(views)
    each = parallel_map(lambda view: _find_curve(shown, [view]), views)
    is_clear = any(change >= CLEAR_TONE for _, change in each)
    return [curve if is_clear else None for curve, _ in each]


def _find_curve(shown: Shown, views: Sequence[int]) -> tuple[np.ndarray | None, float]:
    """Find the common tone curve of some photos, and the median change by it; None and 0 if none is needed.

    It maps quantiles of the photos to quantiles of the Gaussians, which wrong depth and noise hardly change.
    """
    photos, pictures = shown.pairs(list(views))
    least, most = (MIN_TONE_DRAWN, EXPLAINED_DRAWN) if shown.drawn else (MIN_TONE, EXPLAINED)
    before = _difference(photos, pictures)
    if len(photos) < MIN_PIXELS or before < least / 2:  # no curve could change so much and explain it
        return None, 0.0
    tones = np.stack([_join_quantiles(photos[:, channel], pictures[:, channel]) for channel in range(3)])
    after = look_up(tones, photos)
    change = _difference(after, photos)
    is_explained = change >= least and _difference(after, pictures) <= most * before
    return (tones, change) if is_explained else (None, 0.0)


def _join_quantiles(levels: np.ndarray, tones: np.ndarray) -> np.ndarray:
    """Return the curve ``[256]`` float32 that maps the quantiles of one sample to another, proportional at its ends."""
    shares = (np.arange(LEVELS) + 0.5) / LEVELS
    x, y = (np.round(np.quantile(values.astype(np.float64), shares), 6) for values in (levels, tones))
    keep = np.concatenate([[True], np.diff(x) > 1 / 255]) & (x > 0) & (x < 1)
    x, y = x[keep], np.maximum.accumulate(y[keep].clip(0, 1))
    end = min(1.0, max(y[-1], y[-1] / x[-1])) if len(x) else 1.0
    curve = np.interp(np.arange(256) / 255, [0, *x, 1], [0, *y, end])
    return np.round(curve, 6).astype(np.float32)


def share_edges(shown: Shown) -> bool:
    """Return whether photos have edges where their own Gaussians have them, whatever their colours, and others not."""
    photos, pictures = (_shrink(pictures, LOOK_SIDE) for pictures in (shown.photos, shown.pictures))
    first, second = (np.stack([_edges(picture) for picture in each]) for each in (photos, pictures))
    scores = matmul(first, second.T)
    others = float(scores[~np.eye(len(scores), dtype=bool)].mean()) if len(scores) > 1 else 0.0
    return float(np.diag(scores).mean()) > min(OWN_EDGES, others + MORE_EDGES)


def _edges(picture: np.ndarray) -> np.ndarray:
    """Return how strong the edges of a picture are, as a vector of mean 0 and length 1."""
    right, down = np.diff(picture, axis=1)[:-1], np.diff(picture, axis=0)[:, :-1]
    strength = _over_channels(np.maximum, np.maximum(np.abs(right), np.abs(down))).astype(np.float64).ravel()
    away = np.sqrt(strength) - np.sqrt(strength).mean()
    return np.asarray(away / max(float(np.sqrt((away * away).sum())), 1e-9))


def is_recolored(shown: Shown) -> bool:
    """Return whether a linear map of colours explains drawn Gaussians by their photos much better than tones do.

    Drawings are compared so small that wrong depth displaces nothing.
    """
    if _is_reversed(shown, range(len(shown.photos))):  # which is mended
        shown = replace(shown, photos=shown.photos[..., ::-1])
    side = COARSE_SIDE if shown.drawn else SIDE
    weights = _shrink(shown.weights, side)
    counts = weights > (OPAQUE if shown.drawn else FAINT)
    if counts.sum() < MIN_PIXELS:
        return False
    drawn, photos = (
        _shrink(pictures * shown.weights[..., None], side)[counts] / weights[counts][:, None]
        for pictures in (shown.pictures, shown.photos)
    )
    tones = np.stack([_join_quantiles(photos[:, channel], drawn[:, channel]) for channel in range(3)])
    columns = np.concatenate([photos, np.ones((len(photos), 1))], 1).astype(np.float64)
    matrix = solve(matmul(columns.T, columns) + 1e-6 * np.eye(4), matmul(columns.T, drawn.astype(np.float64)))
    by_tones, by_matrix, middle = look_up(tones, photos), matmul(columns, matrix), drawn.mean(0)
    left, best, every = (float(np.square(colors - drawn).mean()) for colors in (by_tones, by_matrix, middle))
    nearer = _difference(by_matrix, drawn) < RECOLORED * _difference(by_tones, drawn)
    return nearer and left > ALIKE**2 and best < RECOLORED**2 * left and best < UNEXPLAINED**2 * every


def _shrink(pictures: np.ndarray, side: int) -> np.ndarray:
    """Average pictures ``[v,h,w,...]`` to at most ``side`` pixels of the longer side."""
    level = max(1.0, max(pictures.shape[1:3]) / side)
    width, height = (max(1, round(side / level)) for side in pictures.shape[2:0:-1])
    return shrink_pictures(pictures.astype(np.float32), width, height)


def odd_photos(shown: Shown) -> list[int]:
    """Return the views whose photos lack the edges that the drawn Gaussians show, or have those of another view."""
    height, width = shown.weights.shape[1:]
    level = max(1.0, max(width, height) / EDGES_SIDE)
    if min(height, width) < 2 or height * width / level**2 < MIN_PIXELS:
        return []
    scores, judged = _correlate_gradients(shown)
    correlations, near = np.diag(scores).copy(), scores.clip(-CLOSEST, CLOSEST)
    z_scores = 0.5 * log((1 + near) / (1 - near))  # inverse hyperbolic tangents
    own = np.diag(z_scores).copy()
    np.fill_diagonal(z_scores, -np.inf)
    z_scores[~judged] = -np.inf
    gains = np.maximum(z_scores.max(0), z_scores.max(1)) - own
    least = max(LEAST, SHARE * float(np.median(correlations[judged]))) if judged.any() else LEAST
    return np.flatnonzero(judged & ((correlations < least) | (gains > GAIN))).tolist()


def _correlate_gradients(shown: Shown) -> tuple[np.ndarray, np.ndarray]:
    """Correlate the image gradients of each view's Gaussians with those of every photo: ``[v,v]``, -1 to 1.

    Exposure does not change the correlation. Also returns a mask ``[v]`` of views with enough structure.
    """
    a = np.stack([_gradients(image) for image in _shrink(shown.pictures, EDGES_SIDE)])
    b = np.stack([_gradients(image) for image in _shrink(shown.photos, EDGES_SIDE)])
    w = np.stack([_gradient_weights(weight) for weight in _shrink(shown.weights, EDGES_SIDE)])
    weighted, squares = w * a, (w * a * a).sum(1)
    sizes = squares[:, None] * matmul(w, (b * b).T)
    scores = np.divide(matmul(weighted, b.T), np.sqrt(sizes), out=np.zeros_like(sizes), where=sizes > 0)
    return scores, squares > FLAT**2 * w.sum(1).clip(1e-9)


def _gradients(image: np.ndarray) -> np.ndarray:
    """Return the differences of an image's grey to the right and down, ``[2·(h-1)·(w-1)]`` float64."""
    grey = _over_channels(np.add, image.astype(np.float64)) / 3
    return np.concatenate([np.diff(grey, axis=1)[:-1].ravel(), np.diff(grey, axis=0)[:, :-1].ravel()])


def _gradient_weights(weight: np.ndarray) -> np.ndarray:
    """Return the weights of :func:`_gradients` from pixel weights ``[h,w]``."""
    both = (weight[:-1, :-1] * weight[:-1, 1:] * weight[1:, :-1]).astype(np.float64).ravel()
    return np.concatenate([both, both])
