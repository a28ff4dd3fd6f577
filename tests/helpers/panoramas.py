"""Views of a made panorama overlap as neighbouring photos do, with photos of other exposure and grain."""

from __future__ import annotations

import numpy as np

from gsmerge.method.compare.view_pictures import ViewPictures
from gsmerge.method.kernels.pictures import blur
from gsmerge.method.raster.photos import shrink_pictures

WIDTH, HEIGHT, STEP = 256, 192, 48  # pixels of a view, and between two


def make_panorama(width: int, seed: int = 0) -> np.ndarray:
    """Make textures of several sizes, ``[HEIGHT,width,3]`` in [0, 1]."""
    rng, out = np.random.default_rng(seed), np.zeros((HEIGHT, width, 3), np.float32)
    for radius in (2, 8, 24):
        grain = blur(rng.standard_normal(out.shape).astype(np.float32), radius)
        out += grain / grain.std()
    return (0.5 + 0.12 * out).clip(0, 1)


def cut_views(count: int, seed: int = 0) -> np.ndarray:
    """Cut views ``[count,HEIGHT,WIDTH,3]``, each :data:`STEP` pixels beside the one before."""
    world = make_panorama(WIDTH + STEP * count, seed)
    return np.stack([world[:, STEP * view : STEP * view + WIDTH] for view in range(count)])


def take_photos(views: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return views as a camera has them: with gains of .7 to 1.2 and grain."""
    rng = np.random.default_rng(seed)
    gains = rng.uniform(0.7, 1.2, (len(views), 1, 1, 1)).astype(np.float32)
    return (gains * views + 0.03 * rng.standard_normal(views.shape).astype(np.float32)).clip(0, 1)


def show(views: np.ndarray, side: int, weights: np.ndarray | None = None) -> ViewPictures:
    """Return views as Gaussians of ``weights [v,h,w]`` show them, of ``side`` pixels."""
    weights = np.ones(views.shape[:3], np.float32) if weights is None else weights
    whole = ViewPictures(np.where(weights[..., None] > 0, views, 0), weights, drawn=True)
    return whole if side >= WIDTH else whole.shrink(side)


def shrunk(photos: np.ndarray, side: int) -> np.ndarray:
    """Return photos of a smaller width."""
    return shrink_pictures(photos, side, round(side * HEIGHT / WIDTH))
