"""Find the Gaussians that ``--drop floaters,sky`` would remove or that few views show, and draw them for a page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace

import numpy as np

from gsmerge.facts.support import TINTS, count_views
from gsmerge.frozen import dataclass
from gsmerge.io.photo_files import encode_indexed
from gsmerge.raster import Splats, TiledView, composite, tile_view
from gsmerge.stages.clean import floaters
from gsmerge.stages.sky import sky
from gsmerge.types import Cameras, Gaussians

Color = tuple[int, int, int]  # sRGB
DROPS: Mapping[str, Color] = {"floaters": (255, 45, 150), "sky": (20, 170, 255)}
SEEN: Mapping[str, Color] = {"none": TINTS[0], "one": TINTS[1]}  # by the number of views that show a Gaussian
MAX_SUPPORT = 2  # larger numbers of views are stored as this number
FAINT = 0.1  # factor on the opacity of faded Gaussians, which no view shows
MAX_MARKED = 300_000  # Gaussians; finding the floaters among more takes seconds
VISIBLE = 0.15  # marked Gaussians are drawn in pixels in which they have at least this share of the light
STEPS, MAX_ALPHA = 8, 190  # number of different opacities of marks, and the largest one, for a share of 1


@dataclass(frozen=True, eq=False)
class Marks:
    """Marks of the n Gaussians of one side of a page."""

    drops: Mapping[str, np.ndarray] = field(default_factory=dict)  # by word of ``--drop``: [n] bool, it would remove
    support: np.ndarray | None = None  # [n] uint8, number of views that show each, at most 2; None: not known

    @property
    def seen(self) -> dict[str, np.ndarray]:
        """Masks ``[n]`` of the Gaussians that "none" or "one" of the views shows, without empty masks."""
        if self.support is None:
            return {}
        masks = {word: self.support == number for number, word in enumerate(SEEN)}
        return {word: mask for word, mask in masks.items() if mask.any()}

    def fade(self, gaussians: Gaussians) -> Gaussians | None:
        """Make the Gaussians that no view shows faint; None if there are none."""
        if "none" not in self.seen:
            return None
        factors = np.where(self.seen["none"], np.float32(FAINT), np.float32(1))
        return replace(gaussians, opacities=gaussians.opacities * factors)


def find_marks(gaussians: Gaussians, cameras: Cameras, photos: np.ndarray | None, *, own: bool) -> Marks:
    """Find the marks of canonical ``gaussians``; if there are more than ``MAX_MARKED``, mark none.

    The sky is found in the ``photos [v,h,w,3]`` of the ``cameras``; None: no sky is found. With ``own``, each view has
    Gaussians of its own, which that view shows, so their support is not marked.
    """
    if len(gaussians) > MAX_MARKED:
        return Marks()
    in_sky = np.zeros(len(gaussians), bool) if photos is None else sky(gaussians, cameras, photos)
    isolated = np.zeros(len(gaussians), bool)
    isolated[~in_sky] = floaters(gaussians[~in_sky])
    drops = {word: mask for word, mask in (("floaters", isolated), ("sky", in_sky)) if mask.any()}
    return Marks(drops, None if own else np.minimum(count_views(gaussians, cameras), MAX_SUPPORT).astype(np.uint8))


def draw_marks(splats: Splats, marks: Marks, camera: Cameras, near: float) -> tuple[bytes | None, bytes | None]:
    """Draw marked Gaussians of canonical ``splats`` in one view: PNGs of ``marks.drops`` and of ``marks.seen``."""
    if not (marks.drops or marks.seen):
        return None, None
    viewmat, K = camera.viewmats[0], camera.Ks[0]
    tiled = tile_view(splats, viewmat, K, camera.width, camera.height, near=near)
    return draw_masks(tiled, marks.drops, DROPS), draw_masks(tiled, marks.seen, SEEN)


def draw_masks(tiled: TiledView, masks: Mapping[str, np.ndarray], colors: Mapping[str, Color]) -> bytes | None:
    """Draw two ``masks [n]`` in the ``colors`` of their words, each as opaque as its share of a pixel's light.

    Returns a PNG; None if no marked Gaussian is visible.
    """
    flags = np.zeros((len(tiled.splats), 3), np.float32)
    for channel, word in enumerate(colors):
        flags[:, channel] = masks.get(word, 0)
    if not flags[tiled.ids].any():
        return None
    first, second, _ = np.moveaxis(composite(tiled, flags)[0], 2, 0)
    share = np.maximum(first, second)
    # 0: transparent; 1 to STEPS: opacities of the first colour; then opacities of the second colour
    ids = np.where(share >= VISIBLE, STEPS * (second > first) + np.ceil(STEPS * share.clip(0, 1)), 0).astype(np.uint8)
    tints = [(*color, MAX_ALPHA * step // STEPS) for color in colors.values() for step in range(1, STEPS + 1)]
    return encode_indexed(ids, np.array([(0, 0, 0, 0), *tints], np.uint8)) if ids.any() else None
