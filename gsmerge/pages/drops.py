"""Find what ``--drop floaters,sky`` would take of a scene, and draw it for a page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from gsmerge.geometry import rgb_to_sh0
from gsmerge.io.photo_files import encode_indexed
from gsmerge.raster import render
from gsmerge.stages.clean import floaters
from gsmerge.stages.sky import sky
from gsmerge.types import Cameras, Gaussians

COLORS = {"floaters": (255, 45, 150), "sky": (20, 170, 255)}  # sRGB
MOST = 300_000  # Gaussians: finding the floaters among more takes seconds
VISIBLE = 0.15  # share of a pixel's light
STEPS, MOST_ALPHA = 8, 190  # of such shares, each of which has an opacity; that of the whole light


def find_drops(gaussians: Gaussians, cameras: Cameras, photos: np.ndarray | None) -> dict[str, np.ndarray]:
    """Return a mask ``[n]`` for each word of ``--drop`` that takes any of the canonical ``gaussians``.

    ``photos [v,h,w,3]`` of the ``cameras`` say where the sky is; None: no sky is found.
    """
    if len(gaussians) > MOST:
        return {}
    above = np.zeros(len(gaussians), bool) if photos is None else sky(gaussians, cameras, photos)
    isolated = np.zeros(len(gaussians), bool)
    isolated[~above] = floaters(gaussians[~above])
    return {word: mask for word, mask in (("floaters", isolated), ("sky", above)) if mask.any()}


def draw_drops(gaussians: Gaussians, masks: Mapping[str, np.ndarray], camera: Cameras, near: float) -> bytes | None:
    """Draw what the ``masks`` take, a colour for each word as opaque as its share, as a WebP; None if none is seen."""
    words = list(COLORS)
    flags = np.stack([masks.get(word, np.zeros(len(gaussians), bool)) for word in (*words, "")], 1)
    marked = replace(gaussians, sh0=rgb_to_sh0(flags.astype(np.float32))[:, None], shN=gaussians.shN[:, :0])
    shares = render(marked, camera, near=near).images[0][..., : len(words)]
    steps = np.ceil(STEPS * shares.max(2).clip(0, 1)).astype(np.uint8)
    ids = np.where(shares.max(2) >= VISIBLE, STEPS * shares.argmax(2) + steps, 0)
    tints = [(*color, MOST_ALPHA * step // STEPS) for color in COLORS.values() for step in range(1, STEPS + 1)]
    return encode_indexed(ids, np.array([(0, 0, 0, 0), *tints], np.uint8)) if ids.any() else None
