"""Find what ``--drop floaters,sky`` would take of a scene, and what few views show, and draw it for a page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from gsmerge.facts.support import TINTS, count_views
from gsmerge.io.photo_files import encode_indexed
from gsmerge.raster import Splats, TiledView, composite, tile_view
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


def find_marks(gaussians: Gaussians, cameras: Cameras, photos: np.ndarray | None, *, own: bool) -> Marks:
    """Find what is marked of canonical ``gaussians``; nothing where there are more than ``MOST``.

    ``photos [v,h,w,3]`` of the ``cameras`` say where the sky is; None: no sky is found. Where views have
    Gaussians of their ``own``, each is shown by one, which is not worth a mark.
    """
    if len(gaussians) > MOST:
        return Marks()
    above = np.zeros(len(gaussians), bool) if photos is None else sky(gaussians, cameras, photos)
    isolated = np.zeros(len(gaussians), bool)
    isolated[~above] = floaters(gaussians[~above])
    drops = {word: mask for word, mask in (("floaters", isolated), ("sky", above)) if mask.any()}
    return Marks(drops, None if own else np.minimum(count_views(gaussians, cameras), MORE).astype(np.uint8))


def draw_marks(splats: Splats, marks: Marks, camera: Cameras, near: float) -> tuple[bytes | None, bytes | None]:
    """Draw what is marked of canonical ``splats``, in one view: ``drops``, and what is ``seen`` by none or one."""
    if not (marks.drops or marks.seen):
        return None, None
    viewmat, K = camera.viewmats[0], camera.Ks[0]
    tiled = tile_view(splats, viewmat, K, camera.width, camera.height, near=near)
    return draw_masks(tiled, marks.drops, DROPS), draw_masks(tiled, marks.seen, SEEN)


def draw_masks(tiled: TiledView, masks: Mapping[str, np.ndarray], colors: Mapping[str, Color]) -> bytes | None:
    """Draw ``masks [n]`` in the ``colors`` of their words, two, each as opaque as its share of a pixel.

    Returns a PNG; None if nothing is seen.
    """
    flags = np.zeros((len(tiled.splats), 3), np.float32)
    for channel, word in enumerate(colors):
        flags[:, channel] = masks.get(word, 0)
    if not flags[tiled.ids].any():
        return None
    first, second, _ = np.moveaxis(composite(tiled, flags)[0], 2, 0)
    most = np.maximum(first, second)
    ids = np.where(most >= VISIBLE, STEPS * (second > first) + np.ceil(STEPS * most.clip(0, 1)), 0).astype(np.uint8)
    tints = [(*color, MOST_ALPHA * step // STEPS) for color in colors.values() for step in range(1, STEPS + 1)]
    return encode_indexed(ids, np.array([(0, 0, 0, 0), *tints], np.uint8)) if ids.any() else None
