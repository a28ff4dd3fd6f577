"""Pack Gaussians for a page: the numbers of a ``.spz``, coarser where there are many, as differences between rows."""

from __future__ import annotations

import json
import zlib
from typing import Any

import numpy as np

from gsmerge.io.formats import spz
from gsmerge.types import Cameras, Gaussians

MAX_GAUSSIANS = 2_000_000  # more take a browser too long to load and a page too many bytes: their stills alone
MAX_SPZ_BYTES = 40_000_000  # before compression: 2 million without harmonics, fewer with them
MIN_OPACITY = 1 / 255  # what is fainter is not drawn
FINE = 11  # bits of a position within the scene: the browser keeps 10 and the sign
MANY = 300_000  # Gaussians that are as small as pixels, each of which may be less exact
# Steps of the numbers of a .spz: opacity, colour, logarithm of the scale; and levels of half a turn's rotation. With
# the coarse ones pictures are 50 dB from those of the exact scene
EXACT, COARSE = ((1, 1, 1), 255), ((16, 2, 2), 31)
PIXEL_PARTS, DEPTH_PARTS = 8, 1024  # of a pixel, and of a depth: steps of what belongs to pixels


def pack_splats(
    gaussians: Gaussians, cameras: Cameras | None = None, pixel_ids: np.ndarray | None = None
) -> tuple[bytes | None, int]:
    """Pack the visible Gaussians with as many harmonics as fit; return bytes (None if too many) and SH degree.

    A gzip stream of a line of JSON and columns: numbers of a ``.spz`` in steps, each less that of the row before, the
    sign as lowest bit, first the low bytes of a column and then the higher ones. Neighbouring rows are similar, so this
    takes 40 to 70 % of the ``.spz``, which the page's script restores. Rows with ``pixel_ids [n]`` among all pixels of
    ``cameras`` have depths and shifts within their pixel for positions. ``gaussians`` and ``cameras`` are in the page's
    frame, where the scene is about 1 large: browsers keep means in 16 bits.
    """
    drawn = gaussians.opacities >= MIN_OPACITY
    for values in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh0, gaussians.shN):
        drawn &= np.isfinite(values).reshape(len(values), -1).all(1)
    count = int(drawn.sum())
    if count > MAX_GAUSSIANS:
        return None, 0
    highest = min(highest_degree(gaussians.shN), spz.MAX_DEGREE)
    degree = max((d for d in range(highest + 1) if (20 + 3 * ((d + 1) ** 2 - 1)) * count <= MAX_SPZ_BYTES), default=0)
    steps, levels = COARSE if count > MANY else EXACT
    stored = spz.spz_columns(gaussians[drawn], degree, fine=FINE)
    means, opacities, colors, scales, _, harmonics = stored.parts
    head: dict[str, Any] = {"count": count, "degree": degree, "fraction": stored.header[13]}
    places = None
    if cameras is not None and pixel_ids is not None:
        places = _pixel_places(gaussians.means[drawn], cameras, pixel_ids[drawn])
        head["cameras"] = [
            {"viewmat": viewmat.reshape(-1).tolist(), "K": K.reshape(-1)[[0, 4, 2, 5]].tolist()}
            for viewmat, K in zip(cameras.viewmats, cameras.Ks, strict=True)
        ]
        head |= {"width": cameras.width, "height": cameras.height, "parts": [PIXEL_PARTS, DEPTH_PARTS]}
    if places is None:
        head.pop("cameras", None)
        places = np.pad(means.reshape(-1, 3, 3), ((0, 0), (0, 0), (1, 0))).view("<i4")[..., 0] >> 8
    opacity, color, scale = (
        np.round(values / step).astype(np.int64)  # halves to even numbers: no bias
        for values, step in zip((opacities, colors, scales), steps, strict=True)
    )
    color[:, 0::2] -= color[:, 1:2]  # from green, which says most of the others
    turns = np.round(levels * _stereographic(gaussians.quats[drawn])).astype(np.int64)
    values = np.concatenate([places, opacity, color, scale, turns, harmonics.astype(np.int64)], axis=1)
    planes, sizes = [], []
    for column in values.T:
        moved = np.diff(column, prepend=0)
        signed = np.where(moved < 0, -2 * moved - 1, 2 * moved).astype("<u4")
        size = max(1, -(-int(signed.max(initial=0)).bit_length() // 8))
        planes.append(signed.view(np.uint8).reshape(-1, 4)[:, :size].T.tobytes())
        sizes.append(size)
    line = json.dumps(head | {"steps": steps, "levels": levels, "sizes": sizes}).encode() + b"\n"
    return spz.gzip_bytes(line + b"".join(planes), 1, zlib.Z_RLE), degree  # differences seldom repeat longer runs


def _pixel_places(means: np.ndarray, cameras: Cameras, ids: np.ndarray) -> np.ndarray | None:
    """Return for each row ``[n,4]`` its pixel, shifts from its middle, and the logarithm of its depth, all in steps.

    ``ids [n]`` rise. None if a row is not in front of its camera.
    """
    size = cameras.width * cameras.height
    seen = np.empty((len(ids), 3))
    for view, (viewmat, K) in enumerate(zip(cameras.viewmats, cameras.Ks, strict=True)):
        rows = slice(*np.searchsorted(ids, (view * size, (view + 1) * size)))  # ids rise
        seen[rows] = (means[rows] @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
    depths = seen[:, 2]
    if not (depths > 0).all():
        return None
    middles = np.stack([ids % cameras.width, ids % size // cameras.width], 1) + 0.5
    shifts = seen[:, :2] / depths[:, None] - middles
    stepped = [PIXEL_PARTS * shifts[:, 0], PIXEL_PARTS * shifts[:, 1], DEPTH_PARTS * np.log(depths)]
    return np.stack([ids.astype(np.int64), *(np.round(part).astype(np.int64) for part in stepped)], 1)


def _stereographic(quats: np.ndarray) -> np.ndarray:
    """Project rotations ``[n,4]`` wxyz to ``[n,3]`` in [-1, 1]: tangents of a quarter of the angle, along the axis."""
    unit = quats.astype(np.float64) / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)
    unit *= np.where(unit[:, :1] < 0, -1, 1)
    return np.asarray(unit[:, 1:] / (1 + unit[:, :1]))


def highest_degree(harmonics: np.ndarray) -> int:
    """Return the highest degree at which harmonics ``[n,k-1,3]`` are not all zero."""
    used = np.flatnonzero(harmonics.any((0, 2)))
    return int(np.sqrt(used[-1] + 1)) if len(used) else 0
