"""Find what ``--drop floaters,sky`` would take of a scene, and what few views show, and draw it for a page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from gsmerge.facts.support import TINTS, count_views
from gsmerge.geometry import rgb_to_sh0
from gsmerge.io.photo_files import encode_indexed
from gsmerge.raster import render
from gsmerge.stages.clean import floaters
from gsmerge.stages.sky import sky
from gsmerge.types import Cameras, Gaussians

Color = tuple[int, int, int]  # sRGB
DROPS: Mapping[str, Color] = {"floaters": (255, 45, 150), "sky": (20, 170, 255)}
SEEN: Mapping[str, Color] = {"none": TINTS[0], "one": TINTS[1]}  # views that show it
MORE = 2  # views from which on it is no matter how many
FAINT = 0.1  # of its opacity is left of what no view shows where that fades
MOST = 300_000  # Gaussians: finding the floaters among more takes seconds
VISIBLE = 0.15  # share of a pixel's light
STEPS, MOST_ALPHA = 8, 190  # of such shares, each of which has an opacity; that of the whole light


@dataclass(frozen=True, eq=False)
class Marks:
    """What is marked of the n Gaussians of one side of a page."""

    drops: Mapping[str, np.ndarray] = field(default_factory=dict)  # [n] bool, what ``--drop`` takes, by its words
    support: np.ndarray | None = None  # [n] uint8, views that show each, 2 for more; None: not known

    @property
    def seen(self) -> dict[str, np.ndarray]:
        """Masks ``[n]`` of what no view and what one view shows, where any is."""
        if self.support is None:
            return {}
        masks = {word: self.support == number for number, word in enumerate(SEEN)}
        return {word: mask for word, mask in masks.items() if mask.any()}

    def fade(self, gaussians: Gaussians) -> Gaussians | None:
        """Make faint what no view shows; None where nothing is such."""
        if "none" not in self.seen:
            return None
        factors = np.where(self.seen["none"], np.float32(FAINT), np.float32(1))
        return replace(gaussians, opacities=gaussians.opacities * factors)


def find_marks(gaussians: Gaussians, cameras: Cameras, photos: np.ndarray | None, *, aligned: bool) -> Marks:
    """Find what is marked of canonical ``gaussians``; nothing where there are more than ``MOST``.

    ``photos [v,h,w,3]`` of the ``cameras`` say where the sky is; None: no sky is found. Of ``aligned`` ones each
    has a view of its own, which is not worth a mark.
    """
    if len(gaussians) > MOST:
        return Marks()
    above = np.zeros(len(gaussians), bool) if photos is None else sky(gaussians, cameras, photos)
    isolated = np.zeros(len(gaussians), bool)
    isolated[~above] = floaters(gaussians[~above])
    drops = {word: mask for word, mask in (("floaters", isolated), ("sky", above)) if mask.any()}
    return Marks(drops, None if aligned else np.minimum(count_views(gaussians, cameras), MORE).astype(np.uint8))


def draw_masks(
    gaussians: Gaussians, masks: Mapping[str, np.ndarray], colors: Mapping[str, Color], camera: Cameras, near: float
) -> bytes | None:
    """Draw ``masks [n]``, at most three, in the ``colors`` of their words, each as opaque as its share of a pixel.

    Returns a PNG; None if nothing is seen.
    """
    if not masks:
        return None
    flags = np.zeros((len(gaussians), 3), np.float32)
    flags[:, : len(colors)] = np.stack([masks.get(word, flags[:, 0] > 0) for word in colors], 1)
    marked = replace(gaussians, sh0=rgb_to_sh0(flags)[:, None], shN=gaussians.shN[:, :0])
    shares = render(marked, camera, near=near).images[0][..., : len(colors)]
    steps = np.ceil(STEPS * shares.max(2).clip(0, 1)).astype(np.uint8)
    ids = np.where(shares.max(2) >= VISIBLE, STEPS * shares.argmax(2) + steps, 0).astype(np.uint8)
    tints = [(*color, MOST_ALPHA * step // STEPS) for color in colors.values() for step in range(1, STEPS + 1)]
    return encode_indexed(ids, np.array([(0, 0, 0, 0), *tints], np.uint8)) if ids.any() else None
