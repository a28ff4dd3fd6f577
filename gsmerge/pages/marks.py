"""Find the Gaussians that ``--drop floaters,sky`` would remove or that few views show, and draw them for a page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import reduce

import numpy as np

from gsmerge.facts.support import TINTS, count_views
from gsmerge.io.encode_pictures import encode_indexed
from gsmerge.raster import Splats, TiledView, tile_view
from gsmerge.raster.composite import blend
from gsmerge.raster.photos import NEAR_PLANE
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


def draw_marks(splats: Splats, marks: Marks, camera: Cameras) -> tuple[bytes | None, bytes | None]:
    """Draw marked Gaussians of canonical ``splats`` in one view: PNGs of ``marks.drops`` and of ``marks.seen``."""
    masks = {**marks.drops, **marks.seen}
    if not masks:
        return None, None
    tiled = tile_view(splats, camera.viewmats[0], camera.Ks[0], camera.width, camera.height, near=NEAR_PLANE)
    shares = light_shares(tiled, masks)
    return draw_shares(shares, DROPS), draw_shares(shares, SEEN)


def light_shares(tiled: TiledView, masks: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the share ``[h,w]`` of each pixel's light that comes from the Gaussians in each of the ``masks [n]``.

    Masks without a Gaussian in the view are left out.
    """
    flags = {word: mask.take(tiled.ids) for word, mask in masks.items()}
    shown, shares = [word for word, flag in flags.items() if flag.any()], dict[str, np.ndarray]()
    for start in range(0, len(shown), 3):  # a mask for each channel of a picture
        colors = np.zeros((len(tiled.ids), 3), np.float32)
        for channel, word in enumerate(shown[start : start + 3]):
            colors[:, channel] = flags[word]
        drawn, _ = blend(tiled, colors, np.zeros(3, np.float32))
        shares |= {word: drawn[..., channel] for channel, word in enumerate(shown[start : start + 3])}
    return shares


def draw_shares(shares: Mapping[str, np.ndarray], colors: Mapping[str, Color]) -> bytes | None:
    """Draw the :func:`light_shares` of two words in their ``colors``, each as opaque as its share.

    Returns a PNG; None if no marked Gaussian is visible.
    """
    shown = [shares[word] for word in colors if word in shares]
    if not shown:
        return None
    share = reduce(np.maximum, shown)
    pixels = np.nonzero(share >= VISIBLE)
    if not len(pixels[0]):
        return None
    first, second = (shares[word][pixels] if word in shares else np.float32(0) for word in colors)
    # 0: transparent; 1 to STEPS: opacities of the first colour; then opacities of the second colour
    ids = np.zeros(share.shape, np.uint8)
    ids[pixels] = STEPS * (second > first) + np.ceil(STEPS * share[pixels].clip(0, 1))
    tints = [(*color, MAX_ALPHA * step // STEPS) for color in colors.values() for step in range(1, STEPS + 1)]
    return encode_indexed(ids, np.array([(0, 0, 0, 0), *tints], np.uint8))
