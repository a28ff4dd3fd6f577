"""Pack Gaussians for a page: the numbers of a ``.spz`` as differences of rows, coarser if there are many Gaussians."""

from __future__ import annotations

import json
import zlib
from functools import reduce
from math import prod
from typing import Any

import numpy as np

from gsmerge.io.formats import spz
from gsmerge.kernels.page_rows import LOOKS, pack_looks, pack_pixels
from gsmerge.raster.photos import LEAST_OPACITY
from gsmerge.types import SH_C0, Cameras, Gaussians

MAX_GAUSSIANS = 2_000_000  # larger scenes have only stills, since a page gets too large and loads too slowly
MAX_SPZ_BYTES = 40_000_000  # before compression; enough for 2 million Gaussians without harmonics
FINE = 11  # bits of a position within the scene; browsers keep 10 bits and the sign
MANY = 300_000  # beyond this number Gaussians are as small as pixels and may be less exact
# Step sizes of the numbers of a .spz (opacity, colour, logarithm of the scale), and levels of half a turn's rotation.
# With COARSE, pictures are 50 dB from those of the exact scene
EXACT, COARSE = ((1, 1, 1), 255), ((16, 2, 2), 31)
PIXEL_PARTS, DEPTH_PARTS = 8, 1024  # steps of a shift per pixel, and of a log depth per unit, for rows of pixels


def pack_splats(
    gaussians: Gaussians, cameras: Cameras | None = None, homes: np.ndarray | None = None
) -> tuple[bytes | None, int]:
    """Pack the visible Gaussians with as many harmonics as fit; return bytes (None if too many) and SH degree.

    The bytes are a gzip stream of a line of JSON and of columns. A column has the numbers of a ``.spz`` in steps, each
    as the difference from the row before, with the sign as the lowest bit. Its low bytes come first, then the higher
    bytes. Neighbouring rows are similar, so this takes 40 to 70 % of the ``.spz``, which the page's script restores.
    Rows with ``homes [n]`` among all pixels of ``cameras`` store a depth and a shift within their pixel in place of a
    position. ``gaussians`` and ``cameras`` are in the page's frame, in which the scene has a size of about 1, since
    browsers keep means in 16 bits.
    """
    rows, means = drawn_rows(gaussians), np.ascontiguousarray(gaussians.means, np.float32)
    count = len(rows)
    if count > MAX_GAUSSIANS:
        return None, 0
    highest = min(highest_degree(gaussians.shN), spz.MAX_DEGREE)
    degree = max((d for d in range(highest + 1) if (20 + 3 * ((d + 1) ** 2 - 1)) * count <= MAX_SPZ_BYTES), default=0)
    steps, levels = COARSE if count > MANY else EXACT
    drawn = means.take(rows, 0)
    fraction = spz.choose_fraction(drawn, FINE)
    head: dict[str, Any] = {"count": count, "degree": degree, "fraction": fraction}
    places = None
    if cameras is not None and homes is not None and (homes >= 0).all():
        places = _pixel_places(rows, means, cameras, homes.astype(np.int64, copy=False))
    if places is None:
        moved = np.diff(spz.fix_means(drawn, fraction), axis=0, prepend=np.zeros((1, 3), np.int32)).T
        places = np.where(moved < 0, -2 * moved - 1, 2 * moved).astype("<u4")
    elif cameras is not None:
        head["cameras"] = [
            {"viewmat": viewmat.reshape(-1).tolist(), "K": K.reshape(-1)[[0, 4, 2, 5]].tolist()}
            for viewmat, K in zip(cameras.viewmats, cameras.Ks, strict=True)
        ]
        head |= {"width": cameras.width, "height": cameras.height, "parts": [PIXEL_PARTS, DEPTH_PARTS]}
    looks = np.empty((LOOKS + 3 * ((degree + 1) ** 2 - 1), count), np.uint32)
    parts = (gaussians.opacities, gaussians.sh0, gaussians.scales, gaussians.quats, gaussians.shN)
    columns = (np.ascontiguousarray(part.reshape(len(part), prod(part.shape[1:])), np.float32) for part in parts)
    pack_looks(rows, *columns, SH_C0, spz.COLOR_SCALE, np.array(steps, np.int32), levels, looks)
    planes, head = [], head | {"steps": steps, "levels": levels, "sizes": []}
    for column in (*places, *looks):
        size = max(1, -(-int(column.max(initial=0)).bit_length() // 8))
        planes.append(column.astype("<u4").view(np.uint8).reshape(-1, 4)[:, :size].T.tobytes())
        head["sizes"].append(size)
    line = json.dumps(head).encode() + b"\n"
    return spz.gzip_bytes(line + b"".join(planes), 1, zlib.Z_RLE), degree  # longer matches are rare in differences


def drawn_rows(gaussians: Gaussians) -> np.ndarray:
    """Return the ids of the rows that :func:`pack_splats` packs, which are finite and visible."""
    drawn = gaussians.opacities >= LEAST_OPACITY
    for values in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh0, gaussians.shN):
        finite = np.isfinite(values).reshape(len(values), prod(values.shape[1:])).T
        drawn &= reduce(np.logical_and, finite, True)  # type: ignore[arg-type]
    return np.flatnonzero(drawn)


def pack_support(support: np.ndarray) -> bytes:
    """Pack the number of views that show each Gaussian, ``[n]`` uint8, as a gzip stream of one byte per Gaussian."""
    return spz.gzip_bytes(support.tobytes(), 9, zlib.Z_DEFAULT_STRATEGY)


def _pixel_places(rows: np.ndarray, means: np.ndarray, cameras: Cameras, ids: np.ndarray) -> np.ndarray | None:
    """Return pixels, shifts and log depths ``[4,m]`` of ``rows [m]`` with pixel ``ids [n]``; None if one is behind."""
    places = np.empty((4, len(rows)), np.uint32)
    viewmats, Ks = (np.ascontiguousarray(part, np.float64) for part in (cameras.viewmats, cameras.Ks))
    sizes = (cameras.width, cameras.height, PIXEL_PARTS, DEPTH_PARTS)
    return places if pack_pixels(rows, ids, means, viewmats, Ks, *sizes, places) == len(rows) else None


def highest_degree(harmonics: np.ndarray) -> int:
    """Return the highest degree at which harmonics ``[n,k-1,3]`` are not all zero."""
    used = np.flatnonzero(harmonics.any((0, 2)))
    return int(np.sqrt(used[-1] + 1)) if len(used) else 0
