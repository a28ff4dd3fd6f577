"""Scene -> the same with photos that look as its Gaussians, without those that do not show it.

Each photo is compared with what the Gaussians show from its camera. Gaussians that belong to pixels
show it in their own colours, whatever their depths are; the others are drawn. What is found and
mended: bars around the pictures, red and blue in the wrong order, another tone (linear light,
exposure, gamma: a curve for each channel), and regions that something covers, which get the
Gaussians' colours, as do pixels that masks leave out. Photos that still do not show the scene,
because they are black, of another scene or of another view, are left out.

A tone or a region is changed only where a drawing of the scene comes nearer to the photo as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from gsmerge.facts.mend_photos import (
    CLIPPED,
    UNCHANGED,
    PhotoChange,
    is_change,
    list_names,
    look_up,
    mend_photos,
    own_pictures,
)
from gsmerge.facts.place_cameras import sampled
from gsmerge.geometry import sh0_to_rgb
from gsmerge.kernels.elementary import log
from gsmerge.kernels.matrices import matmul
from gsmerge.kernels.pictures import count_bars
from gsmerge.raster.photos import blank_photos, photo_errors, photos_of, pixel_weights
from gsmerge.runtime.record import choose, note
from gsmerge.runtime.threads import in_turn, parallel_map
from gsmerge.types import PicturedScene, Scene

# On 14 captures right photos reach 0.99 and more with the colours of pixels, 0.13 to 0.8 with drawings; noise mostly
# stays below 0.06, photos of other views below 0.3.
SIDE = 48  # pixels of the longer side, for telling whether a photo shows the scene
SAMPLES = 1 << 17  # Gaussians that are drawn
MIN_PIXELS = 64  # of a small picture
FLAT = 1 / 255  # root mean square of a view's gradients, sRGB: below it a view shows nothing to go by
LEAST, LEAST_DRAWN = 0.25, 0.06  # correlation of a photo that shows the scene
SHARE = 0.25  # the same, as a share of the median of all photos
GAIN = 0.4  # of the inverse hyperbolic tangent of the correlation: more with another view, and the photo is of that one
CLOSEST = 0.995  # correlation above which photos are equally good

# Differences of the colours in [0, 1]. Of 15 captures the photos differ from the pixels' own colours by 0.003, and from
# drawings by 0.01 to 0.2; the order of the channels raises that by 8 % at the least, and no region differs by 0.1.
SMALL_SIDE, SMALL_DRAWN = 192, 96  # pixels of the longer side for these comparisons
BORDER, MIN_BAR = 8 / 255, 0.02  # range of a bar's colours; share of a side that bars cover together, at the least
SWAPPED, MIN_SWAP = 0.75, 0.01  # difference with channels reversed, of that without; and by how much it is less
LEVELS = 33  # quantiles that a tone curve joins
MIN_TONE, MIN_TONE_DRAWN = 0.03, 0.08  # median change of the colours from which on a tone is compensated
CLEAR_TONE = 0.05  # the same of one photo at least, where Gaussians have pixels
EXPLAINED, EXPLAINED_DRAWN = 0.5, 0.6  # most of the difference that the curve may leave
DARK = 3 / 255  # brightest pixel of a black region
SAME = 2.5 / 255  # range of a flat region's colours
COVERED, DOUBT = 0.12, 4.0  # difference from which on a region is covered; times that of three quarters of the pixels
FLAT_COVER = 0.025  # the same of half of the pixels of a region of one colour
PATCH = 9  # pixels of the small picture over which differences are averaged
MIN_COVER, MIN_COVER_DRAWN = 0.01, 0.05  # share of the picture of the least such region
MAX_COVER = 0.9  # share of a photo from which on nothing can be said of the rest


@dataclass(frozen=True, eq=False)
class Shown:
    """Small pictures of each photo and of the Gaussians from the same camera."""

    photos: np.ndarray  # [v,h,w,3]
    pictures: np.ndarray  # [v,h,w,3]
    weights: np.ndarray  # [v,h,w] how much of a pixel the Gaussians show; 0 outside the masks
    drawn: bool  # whether the pictures are drawings, which wrong depth displaces

    @property
    def clear(self) -> np.ndarray:
        """Mask ``[v,h,w]`` of pixels where the Gaussians are opaque enough for ``pictures`` to be compared."""
        return self.weights > (0.5 if self.drawn else 0.05)


def compare_photos(scene: PicturedScene) -> tuple[PicturedScene, tuple[int, ...]]:
    """Mend the photos of a canonical scene, and replace those that do not show it.

    Returns the scene and the views whose photos a fit may use; there are none if most photos do not show the scene. The
    record gets notes and the choices ``photos_changed`` and ``photos_left_out``.
    """
    shown = show_photos(scene)
    changes = find_changes(scene, shown)
    mended = mend_photos(scene, changes)
    return _leave_out(mended, _change_small(shown, changes))


def find_changes(scene: PicturedScene, shown: Shown) -> list[PhotoChange]:
    """Find what needs mending in each photo; add notes about it."""
    views = range(len(scene))
    changes = [replace(UNCHANGED, bars=_find_bars(scene, shown))] * len(scene)
    small = _change_small(shown, changes)
    if _is_reversed(small):
        note("red and blue are in the wrong order in the photos (BGR): they change places")
        changes = [replace(change, reversed=True) for change in changes]
        small = _change_small(shown, changes)
    odd = [view for view in views if _is_reversed_alone(small, view)]
    if odd:
        names = list_names(scene.names, odd)
        note(f"red and blue are in another order in {len(odd)} of {len(scene)} photos: they change places: {names}")
        changes = [replace(change, reversed=change.reversed != (view in odd)) for view, change in enumerate(changes)]
        small = _change_small(shown, changes)
    flat = parallel_map(lambda view: _flat_regions(small, view), views)
    curves = _find_tones(small, flat)
    drawing: np.ndarray | None = None
    clear = small.clear

    def find_cover(view: int) -> tuple[PhotoChange, np.ndarray, np.ndarray | None]:
        change = replace(changes[view], tones=curves[view])
        photo = change(shown.photos[view], None)
        return change, photo, _covered(small.pictures[view], photo, clear[view], flat[view], drawn=small.drawn)

    for view, (change, photo, cover) in enumerate(in_turn(find_cover, views)):
        picture = small.pictures[view]
        if (curves[view] is None and cover is None) or (cover is not None and cover.mean() > MAX_COVER):
            continue
        if drawing is None:
            drawing = small.pictures if small.drawn else _draw(scene, SMALL_SIDE)[0]
        changes[view] = _confirmed(change, cover, small.photos[view], photo, picture, drawing[view])
    return changes


def _confirmed(
    change: PhotoChange, cover: np.ndarray | None, before: np.ndarray, after: np.ndarray, picture: np.ndarray,
    drawing: np.ndarray,
) -> PhotoChange:  # fmt: skip
    """Return the parts of a change that also bring the photo nearer to a drawing of the scene."""
    outside = np.full(before.shape[:2], True) if cover is None else ~cover
    if change.tones is not None and not _difference(after, drawing, outside) < _difference(before, drawing, outside):
        change = replace(change, tones=None)
    if cover is not None and _difference(picture, drawing, cover) < _difference(after, drawing, cover):
        change = replace(change, cover=cover)
    return change


def show_photos(scene: PicturedScene) -> Shown:
    """Make small pictures of the photos of a canonical scene, and of what the Gaussians show there."""
    drawn = not scene.aligned
    side = SMALL_DRAWN if drawn else SMALL_SIDE
    level = max(1.0, max(scene.cameras.width, scene.cameras.height) / side)
    photos = photos_of(scene.images, scene.cameras, level)
    pictures, weights = _draw(scene, side) if drawn else _shrink_colors(scene, (photos.width, photos.height))
    inside = pixel_weights(scene.masks, photos.width, photos.height)
    if inside is not None:
        weights = weights * (inside == 1)
    return Shown(photos.images, pictures, weights, drawn)


def _shrink_colors(scene: Scene, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the colours ``[v,h,w,3]`` and opacities ``[v,h,w]`` of the Gaussians of the pixels at a small size."""
    shape = scene.valid.shape
    colors = scene.gaussians.sh0.reshape(*shape, 3)
    opacities = np.where(scene.valid, scene.gaussians.opacities.reshape(shape), 0).astype(np.float32)

    def shrink(view: int) -> tuple[np.ndarray, np.ndarray]:
        color, weight = (np.ascontiguousarray(values[view], np.float32) for values in (colors, opacities))
        small = cv2.resize(sh0_to_rgb(color).clip(0, 1), size, interpolation=cv2.INTER_AREA)
        return small, cv2.resize(weight, size, interpolation=cv2.INTER_AREA)

    pictures, weights = zip(*parallel_map(shrink, range(len(scene))), strict=True)
    return np.stack(pictures), np.stack(weights)


def _draw(scene: Scene, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw a sample of the Gaussians in every view: pictures ``[v,h,w,3]`` and opacities ``[v,h,w]``."""
    level = max(1.0, max(scene.cameras.width, scene.cameras.height) / side)
    few, blank = sampled(scene.gaussians, SAMPLES), blank_photos(scene.cameras, level)
    drawn = photo_errors(few, blank, lambda _, image, left: (image.clip(0, 1), 1 - left))
    pictures, weights = zip(*drawn, strict=True)
    return np.stack(pictures), np.stack(weights)


def _change_small(shown: Shown, changes: Sequence[PhotoChange]) -> Shown:
    """Mend the small photos; covered pixels get a weight of zero."""
    if not any(map(is_change, changes)):
        return shown
    photos = [change(photo, fill) for change, photo, fill in zip(changes, shown.photos, shown.pictures, strict=True)]
    weights = [
        weight if change.cover is None else weight * ~change.cover
        for change, weight in zip(changes, shown.weights, strict=True)
    ]
    return replace(shown, photos=np.stack(photos), weights=np.stack(weights))


def _difference(picture: np.ndarray, other: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the median difference of two pictures over the pixels of a mask; 0 without any."""
    values = _over_channels(np.add, np.abs(picture - other)) / 3
    chosen = values if mask is None else values[mask]
    return float(np.median(chosen)) if chosen.size else 0.0


def _over_channels(combine: np.ufunc, image: np.ndarray) -> np.ndarray:
    """Combine the three channels ``[...,3]`` of a picture, faster than a reduction over so short an axis."""
    return np.asarray(combine(combine(image[..., 0], image[..., 1]), image[..., 2]))


def _find_bars(scene: PicturedScene, shown: Shown) -> tuple[float, float, float, float]:
    """Find bars (shares of the sides) without which all pictures show the scene better; zeros if there are none."""
    height, width = scene.images.shape[1:3]
    none = (0.0, 0.0, 0.0, 0.0)
    sides = np.median([count_bars(image, BORDER) for image in scene.images], 0).astype(int)
    bars = (sides[0] / height, sides[1] / height, sides[2] / width, sides[3] / width)
    if max(bars[0] + bars[1], bars[2] + bars[3]) < MIN_BAR:
        return none
    change = PhotoChange(bars=bars)
    cropped = _change_small(shown, [change] * len(scene))
    rows, columns = shown.weights.shape[1:]
    inside = np.zeros((rows, columns), bool)
    inside[change.inside(rows, columns)] = True
    as_cover = replace(shown, weights=shown.weights * inside)
    scores = [float(np.median(np.diag(gradient_correlations(trial)[0]))) for trial in (cropped, as_cover, shown)]
    least = LEAST_DRAWN if shown.drawn else LEAST
    if scores[0] <= max(*scores[1:], least):
        return none
    places = zip(bars, ("above", "below", "left", "right"), strict=True)
    what = ", ".join(f"{100 * bar:.0f} % {name}" for bar, name in places if bar)
    note(f"the photos have bars around the pictures ({what}): they are cut off and the pictures enlarged")
    return bars


def _is_reversed(shown: Shown) -> bool:
    """Return whether all photos together are nearer to their Gaussians with red and blue exchanged."""
    counts = shown.clear
    rgb, bgr = (_difference(photos, shown.pictures, counts) for photos in (shown.photos, shown.photos[..., ::-1]))
    return bgr < SWAPPED * rgb and rgb - bgr > MIN_SWAP


def _is_reversed_alone(shown: Shown, view: int) -> bool:
    """Return whether red and blue are exchanged in one photo: red less blue falls where that of its Gaussians rises.

    No change of tone has this effect.
    """
    part = replace(shown, **{name: getattr(shown, name)[[view]] for name in ("photos", "pictures", "weights")})
    if not _is_reversed(part):
        return False
    pair = ((images[..., 0] - images[..., 2])[part.clear] for images in (part.photos, part.pictures))
    photo, picture = (values - np.median(values) for values in pair)
    return bool((photo * picture).sum() < 0)


def _find_tones(shown: Shown, flat: Sequence[np.ndarray]) -> list[np.ndarray | None]:
    """Find the tone curves ``[3,256]`` from each photo to its Gaussians; None for a photo whose tone is right.

    Drawn scenes have one curve for all photos. Small changes count only if some photo needs a clear one, since models
    have a tone of their own.
    """
    views = range(len(shown.photos))
    if shown.drawn:
        return [_find_curves(shown, views, shown.clear)[0]] * len(views)
    each = parallel_map(lambda view: _find_curves(shown, [view], shown.clear[[view]] & ~flat[view]), views)
    is_clear = any(change >= CLEAR_TONE for _, change in each)
    return [curves if is_clear else None for curves, _ in each]


def _find_curves(shown: Shown, views: Sequence[int], counts: np.ndarray) -> tuple[np.ndarray | None, float]:
    """Find common tone curves of a group of photos, and the median change by them; None and 0 if none is needed.

    The curves map quantiles of the photos to quantiles of the Gaussians, which wrong depth and noise hardly change.
    """
    if counts.sum() < MIN_PIXELS:
        return None, 0.0
    photos, pictures = shown.photos[list(views)][counts], shown.pictures[list(views)][counts]
    least, most = (MIN_TONE_DRAWN, EXPLAINED_DRAWN) if shown.drawn else (MIN_TONE, EXPLAINED)
    before = _difference(photos, pictures)
    if before < least / 2:  # no curve could change so much and explain it
        return None, 0.0
    tones = np.stack([_curve(photos[:, channel], pictures[:, channel]) for channel in range(3)])
    after = look_up(tones, photos)
    change = _difference(after, photos)
    is_explained = change >= least and _difference(after, pictures) <= most * before
    return (tones, change) if is_explained else (None, 0.0)


def _curve(levels: np.ndarray, tones: np.ndarray) -> np.ndarray:
    """Return the curve ``[256]`` float32 that maps the quantiles of one sample to another, proportional at its ends."""
    shares = (np.arange(LEVELS) + 0.5) / LEVELS
    x, y = (np.round(np.quantile(values.astype(np.float64), shares), 6) for values in (levels, tones))
    keep = np.concatenate([[True], np.diff(x) > 1 / 255]) & (x > 0) & (x < 1)
    x, y = x[keep], np.maximum.accumulate(y[keep].clip(0, 1))
    end = min(1.0, max(y[-1], y[-1] / x[-1])) if len(x) else 1.0
    curve = np.interp(np.arange(256) / 255, [0, *x, 1], [0, *y, end])
    return np.round(curve, 6).astype(np.float32)


def _flat_regions(shown: Shown, view: int) -> np.ndarray:
    """Return a mask ``[h,w]`` of large regions of one colour in a photo; for drawn scenes, of black regions."""
    photo, kernel = shown.photos[view], np.ones((5, 5))
    spread = _over_channels(np.maximum, cv2.dilate(photo, kernel) - cv2.erode(photo, kernel))
    if shown.drawn:
        return _large_parts((_over_channels(np.maximum, photo) <= DARK) & (spread <= DARK), MIN_COVER)
    flat = spread <= SAME
    return _large_parts(flat, MIN_COVER) if flat.mean() >= MIN_COVER else np.zeros_like(flat)


def _large_parts(mask: np.ndarray, share: float, marked: np.ndarray | None = None) -> np.ndarray:
    """Select connected parts of a mask that cover a share of the picture and have half of their pixels ``marked``."""
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    sizes = np.bincount(labels.ravel(), minlength=count)
    keep = sizes >= share * mask.size
    if marked is not None:
        keep &= np.bincount(labels.ravel(), marked.ravel(), count) >= 0.5 * sizes
    keep[0] = False
    return np.asarray(keep[labels])


def _covered(
    picture: np.ndarray, photo: np.ndarray, clear: np.ndarray, flat: np.ndarray, *, drawn: bool
) -> np.ndarray | None:
    """Return a mask ``[h,w]`` of pixels of a photo where something covers the scene; None if nothing does."""
    clipped = _over_channels(np.maximum, photo) > CLIPPED
    seen = (clear & (flat | ~clipped)).astype(np.float32)
    share = _box_means(seen[..., None])[..., 0]
    away = np.abs(_box_means((photo - picture) * seen[..., None]))
    away = _over_channels(np.add, away) / (3 * np.maximum(share, 0.1))
    textured = clear & ~flat
    usual = float(np.quantile(away[textured], 0.75)) if textured.any() else 0.0
    limit = max(COVERED, DOUBT * usual)
    if drawn:
        parts = _large_parts(flat & (away > limit) & clear, MIN_COVER_DRAWN)
    else:
        parts = _large_parts((away > limit) & (share > 0.5), MIN_COVER)
        parts |= _large_parts(flat, MIN_COVER, away > FLAT_COVER)
    if not parts.any():
        return None
    return np.asarray(cv2.dilate(parts.astype(np.uint8), np.ones((PATCH, PATCH), np.uint8)) > 0)


def _box_means(image: np.ndarray) -> np.ndarray:
    """Average a picture ``[h,w,c]`` over squares of ``PATCH`` pixels around each pixel; 0 beyond the border."""
    half = PATCH // 2
    padded = np.pad(image.astype(np.float64), ((half + 1, half), (half + 1, half), (0, 0)))
    sums = padded.cumsum(0).cumsum(1)
    down = sums[PATCH:] - sums[:-PATCH]
    return np.asarray((down[:, PATCH:] - down[:, :-PATCH]) / PATCH**2)


def _leave_out(scene: PicturedScene, shown: Shown) -> tuple[PicturedScene, tuple[int, ...]]:
    """Replace photos that do not show the scene by the Gaussians' own colours; return the views of the other photos."""
    views, odd = tuple(range(len(scene))), odd_photos(shown)
    if not odd:
        return scene, views
    choose(photos_left_out=[scene.names[view] for view in odd])
    problem = f"{len(odd)} of {len(views)} photos do not show what the Gaussians show"
    if 2 * len(odd) > len(views):
        which = list_names(scene.names, odd)
        result = " and nothing is fitted" if shown.drawn else ""
        note(f"{problem}, so none is used{result}: {which}; check their names and order")
        return scene, ()
    note(f"{problem} and are not used: {list_names(scene.names, odd)}")
    images = scene.images.copy()
    images[odd] = own_pictures(scene, odd)
    return replace(scene, images=images), tuple(view for view in views if view not in odd)


def odd_photos(shown: Shown) -> list[int]:
    """Return the views whose photos show something other than the Gaussians."""
    height, width = shown.weights.shape[1:]
    least = LEAST_DRAWN if shown.drawn else LEAST
    level = max(1.0, max(width, height) / SIDE)
    if min(height, width) < 2 or height * width / level**2 < MIN_PIXELS:
        return []
    scores, judged = gradient_correlations(shown)
    correlations, near = np.diag(scores).copy(), scores.clip(-CLOSEST, CLOSEST)
    z_scores = 0.5 * log((1 + near) / (1 - near))  # inverse hyperbolic tangents
    fits = np.diag(z_scores).copy()
    np.fill_diagonal(z_scores, -np.inf)
    z_scores[~judged] = -np.inf
    gains = np.maximum(z_scores.max(0), z_scores.max(1)) - fits
    if judged.any():
        least = max(least, SHARE * float(np.median(correlations[judged])))
    return np.flatnonzero(judged & ((correlations < least) | (gains > GAIN))).tolist()


def gradient_correlations(shown: Shown) -> tuple[np.ndarray, np.ndarray]:
    """Correlate the image gradients of each view's Gaussians with those of every photo: ``[v,v]``, -1 to 1.

    Exposure does not change the correlation. Also returns a mask ``[v]`` of views with enough structure.
    """
    height, width = shown.weights.shape[1:]
    level = max(1.0, max(width, height) / SIDE)
    size = max(1, round(width / level)), max(1, round(height / level))

    def shrink(images: np.ndarray) -> list[np.ndarray]:
        return [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images.astype(np.float32)]

    a = np.stack([_gradients(image) for image in shrink(shown.pictures)])
    b = np.stack([_gradients(image) for image in shrink(shown.photos)])
    w = np.stack([_gradient_weights(weight) for weight in shrink(shown.weights)])
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
