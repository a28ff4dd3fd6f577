"""Scene -> the same without photos that do not show it: black, of another scene, or of another view.

A photo is compared with what the Gaussians show from its camera by the correlation of the gradients
of small pictures, which no exposure changes, and with what they show from the other cameras: a
photo that fits another one much better was mistaken for it. Of Gaussians that belong to pixels the
colours of a view's own are compared, because those show the view whatever their depths are; the
others are drawn.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from gsmerge.geometry import sh0_to_rgb
from gsmerge.kernels.elementary import log
from gsmerge.kernels.matrices import matmul
from gsmerge.render import render
from gsmerge.render.photos import photo_errors, photos_of, scene_pictures
from gsmerge.runtime.record import choose, note
from gsmerge.runtime.threads import parallel_map
from gsmerge.stages.place_cameras import sampled
from gsmerge.types import Scene
from gsmerge.views import subset

# On 14 captures right photos reach 0.99 and more with the colours of pixels, 0.13 to 0.8 with drawings; noise mostly
# stays below 0.06, photos of other views below 0.3.
SIDE = 48  # pixels of the longer side
SAMPLES = 1 << 17  # Gaussians that are drawn
MIN_PIXELS = 64  # of a small picture
FLAT = 1 / 255  # root mean square of a view's gradients, sRGB: below it a view shows nothing to go by
LEAST, LEAST_DRAWN = 0.25, 0.06  # correlation of a photo that shows the scene
SHARE = 0.25  # the same, as a share of the median of all photos
GAIN = 0.4  # of the inverse hyperbolic tangent of the correlation: more with another view, and the photo is of that one
CLOSEST = 0.995  # correlation above which photos are equally good
NAMED = 4  # views that the note names


def leave_out_photos(scene: Scene) -> tuple[Scene, tuple[int, ...]]:
    """Replace photos that do not show the scene by the Gaussians' own colours, or remove all photos.

    All are removed where most do not show the canonical scene. Returns the scene, and the views
    whose pictures a fit may use. The record gets a note and the choice ``photos_left_out``.
    """
    views = tuple(range(len(scene)))
    odd = [] if scene.images is None else odd_photos(scene)
    if not odd or scene.images is None:
        return scene, views
    names = [scene.names[view] for view in odd]
    choose(photos_left_out=names)
    more = f" and {len(odd) - NAMED} more" if len(odd) > NAMED else ""
    which = ", ".join(names[:NAMED]) + more
    problem = f"{len(odd)} of {len(views)} photos do not show what the Gaussians show"
    if 2 * len(odd) > len(views):
        note(f"{problem}, so none is used and nothing is fitted: {which}; check their names and order")
        return replace(scene, images=None, large_photos=None), ()
    note(f"{problem} and are not used: {which}")
    images = scene.images.copy()
    images[odd] = _own_pictures(scene, odd)
    return replace(scene, images=images), tuple(view for view in views if view not in odd)


def odd_photos(scene: Scene) -> list[int]:
    """Return the views of a canonical scene whose photos do not show it, judged by the Gaussians."""
    assert scene.images is not None
    least = LEAST if scene.aligned else LEAST_DRAWN
    level = max(scene.cameras.width, scene.cameras.height) / SIDE
    if min(scene.images.shape[1:3]) < 2 or scene.pixels_per_view / max(level, 1) ** 2 < MIN_PIXELS:
        return []
    scores, judged = gradient_correlations(scene, max(level, 1.0))
    own, near = np.diag(scores).copy(), scores.clip(-CLOSEST, CLOSEST)
    others = 0.5 * log((1 + near) / (1 - near))  # inverse hyperbolic tangents
    fits = np.diag(others).copy()
    np.fill_diagonal(others, -np.inf)
    others[~judged] = -np.inf
    gains = np.maximum(others.max(0), others.max(1)) - fits
    if judged.any():
        least = max(least, SHARE * float(np.median(own[judged])))
    return np.flatnonzero(judged & ((own < least) | (gains > GAIN))).tolist()


def gradient_correlations(scene: Scene, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Correlate the gradients of each view's Gaussians with those of every photo: ``[v,v]``, -1 to 1.

    Sides of the pictures are divided by ``level``. Also returns a mask ``[v]`` of views with enough
    structure.
    """
    assert scene.images is not None
    photos = photos_of(scene.images, scene.cameras, level)
    if scene.aligned:
        shape, size = scene.valid.shape, (photos.width, photos.height)
        colors = scene.gaussians.sh0.reshape(*shape, 3)
        weights = np.where(scene.valid, scene.gaussians.opacities.reshape(shape), 0).astype(np.float32)

        def shrink(view: int) -> tuple[np.ndarray, np.ndarray]:
            color, weight = (np.ascontiguousarray(some[view], np.float32) for some in (colors, weights))
            small = cv2.resize(sh0_to_rgb(color), size, interpolation=cv2.INTER_AREA)
            return small, cv2.resize(weight, size, interpolation=cv2.INTER_AREA)

        shown = parallel_map(shrink, range(len(scene)))
    else:
        few = sampled(scene.gaussians, SAMPLES)
        shown = photo_errors(few, photos, lambda _, image, left: (image.clip(0, 1), 1 - left))
    a = np.stack([_gradients(image) for image, _ in shown])
    b = np.stack([_gradients(image) for image in photos.images])
    w = np.stack([_gradient_weights(weight) for _, weight in shown])
    weighted, squares = w * a, (w * a * a).sum(1)
    sizes = squares[:, None] * matmul(w, (b * b).T)
    scores = np.divide(matmul(weighted, b.T), np.sqrt(sizes), out=np.zeros_like(sizes), where=sizes > 0)
    return scores, squares > FLAT**2 * w.sum(1).clip(1e-9)


def _gradients(image: np.ndarray) -> np.ndarray:
    """Return the differences of an image's grey to the right and down, ``[2·(h-1)·(w-1)]`` float64."""
    grey = image.mean(-1, dtype=np.float64)
    return np.concatenate([np.diff(grey, axis=1)[:-1].ravel(), np.diff(grey, axis=0)[:, :-1].ravel()])


def _gradient_weights(weight: np.ndarray) -> np.ndarray:
    """Return the weights of :func:`_gradients` from pixel weights ``[h,w]``."""
    both = (weight[:-1, :-1] * weight[:-1, 1:] * weight[1:, :-1]).astype(np.float64).ravel()
    return np.concatenate([both, both])


def _own_pictures(scene: Scene, views: list[int]) -> np.ndarray:
    """Return some views of a scene in the colours of its Gaussians, ``[n,h,w,3]``."""
    if not scene.aligned:
        return np.asarray(render(scene.gaussians, scene.cameras[views]).images).clip(0, 1)
    return scene_pictures(replace(subset(scene, views), images=None))
