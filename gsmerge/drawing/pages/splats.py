"""Pack Gaussians for a page, as the differences between rows of a ``.spz``; many Gaussians are stored less exactly."""

from __future__ import annotations

import json
import zlib
from functools import reduce
from math import prod
from typing import Any

import numpy as np

from gsmerge.io.formats import spz
from gsmerge.method.kernels.page_rows import LOOKS, pack_looks, pack_pixels
from gsmerge.method.raster.photos import LEAST_OPACITY
from gsmerge.types import SH_C0, Cameras, Gaussians

MAX_GAUSSIANS = 2_000_000  # larger scenes have only stills, since a page gets too large and loads too slowly
MAX_SPZ_BYTES = 40_000_000  # before compression; enough for 2 million Gaussians without harmonics
COARSE_COUNT = 300_000  # larger scenes have Gaussians as small as pixels, which may be less exact
# Step sizes of opacity, colour and logarithm of the scale, in steps of a .spz, and the number of steps of a rotation
# from 0 to half a turn. With COARSE, pictures have a PSNR of 50 dB against pictures of the exact scene
EXACT = ((1, 1, 1), 255)
COARSE = ((16, 2, 2), 31)
# steps per pixel of a shift within it, and steps per unit of a logarithm of depth
PIXEL_PARTS = 8
DEPTH_PARTS = 1024


def pack_splats(
    gaussians: Gaussians, cameras: Cameras | None = None, homes: np.ndarray | None = None
) -> tuple[bytes | None, int]:
    """Pack the visible Gaussians with as many harmonics as fit; return the bytes and the degree of these harmonics.

    If there are more than ``MAX_GAUSSIANS``, the bytes are None, and the degree is 0.

    The page's script unpacks the bytes to a ``.spz``. The bytes are a gzip stream of a line of JSON and of columns. A
    column has one number of each Gaussian, as the difference from the Gaussian before. The lowest bit of a number is
    the sign. All low bytes of a column come first, then the higher bytes. Neighbouring rows are similar, so the bytes
    take 40 to 70 % of the ``.spz``.

    ``homes [n]`` is the pixel of each Gaussian, numbered over the pictures of all ``cameras``, or -1. If every Gaussian
    has a pixel, its depth and its shift within the pixel are stored instead of its position. ``gaussians`` and
    ``cameras`` are in the page's frame. The scene has a size of about 1 in this frame, since browsers keep means in 16
    bits.
    """
    rows = drawn_rows(gaussians)
    means = np.ascontiguousarray(gaussians.means, np.float32)
    count = len(rows)
    if count > MAX_GAUSSIANS:
        return None, 0
    highest = min(highest_degree(gaussians.shN), spz.MAX_DEGREE)
    row_bytes = 20  # bytes of a Gaussian in a .spz, besides one for each harmonic
    degrees = (d for d in range(highest + 1) if (row_bytes + _num_harmonics(d)) * count <= MAX_SPZ_BYTES)
    degree = max(degrees, default=0)
    steps, levels = COARSE if count > COARSE_COUNT else EXACT
    drawn_means = means.take(rows, 0)
    position_bits = 11  # bits of a position within the scene; browsers keep 10 bits and the sign
    fraction = spz.choose_fraction(drawn_means, position_bits)
    head: dict[str, Any] = {"count": count, "degree": degree, "fraction": fraction}
    positions = None
    if cameras is not None and homes is not None and (homes >= 0).all():
        # Row 0 has the pixels, rows 1 and 2 the shifts within them, and row 3 the logarithms of the depths
        in_pixels = np.empty((4, count), np.uint32)
        viewmats, Ks = (np.ascontiguousarray(array, np.float64) for array in (cameras.viewmats, cameras.Ks))
        sizes = (cameras.width, cameras.height, PIXEL_PARTS, DEPTH_PARTS)
        num_packed = pack_pixels(rows, homes.astype(np.int64, copy=False), means, viewmats, Ks, *sizes, in_pixels)
        if num_packed == count:  # otherwise a Gaussian cannot be stored like this, for example behind its camera
            positions = in_pixels
            # With these entries the page's script computes positions from pixels and depths
            poses = [
                {"viewmat": viewmat.reshape(-1).tolist(), "K": [K[0, 0].item(), K[1, 1].item(), *K[:2, 2].tolist()]}
                for viewmat, K in zip(cameras.viewmats, cameras.Ks, strict=True)
            ]
            size = {"width": cameras.width, "height": cameras.height}
            head |= {"cameras": poses, **size, "parts": [PIXEL_PARTS, DEPTH_PARTS]}
    if positions is None:
        changes = np.diff(spz.quantise_means(drawn_means, fraction), axis=0, prepend=np.zeros((1, 3), np.int32)).T
        positions = np.where(changes < 0, -2 * changes - 1, 2 * changes).astype("<u4")
    looks = np.empty((LOOKS + _num_harmonics(degree), count), np.uint32)
    arrays = (gaussians.opacities, gaussians.sh0, gaussians.scales, gaussians.quats, gaussians.shN)
    columns = (np.ascontiguousarray(array.reshape(len(array), prod(array.shape[1:])), np.float32) for array in arrays)
    pack_looks(rows, *columns, SH_C0, spz.COLOR_SCALE, np.array(steps, np.int32), levels, looks)  # fills looks
    # bytes per number of each column, and the columns
    column_bytes = list[int]()
    planes = list[bytes]()
    for column in (*positions, *looks):
        num_bytes = max(1, -(-int(column.max(initial=0)).bit_length() // 8))
        column_bytes.append(num_bytes)
        planes.append(column.astype("<u4").view(np.uint8).reshape(-1, 4)[:, :num_bytes].T.tobytes())
    head |= {"steps": steps, "levels": levels, "sizes": column_bytes}
    content = json.dumps(head).encode() + b"\n" + b"".join(planes)
    return spz.gzip_bytes([content], level=1, strategy=zlib.Z_RLE), degree  # longer matches are rare in differences


def _num_harmonics(degree: int) -> int:
    """Return the number of values of shN at a degree: three channels of each harmonic."""
    return 3 * ((degree + 1) ** 2 - 1)


def drawn_rows(gaussians: Gaussians) -> np.ndarray:
    """Return the ids of the finite and visible rows, which :func:`pack_splats` packs."""
    drawn = gaussians.opacities >= LEAST_OPACITY
    for values in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh0, gaussians.shN):
        finite = np.isfinite(values).reshape(len(values), prod(values.shape[1:])).T
        drawn &= reduce(np.logical_and, finite, True)  # type: ignore[arg-type]
    return np.flatnonzero(drawn)


def highest_degree(harmonics: np.ndarray) -> int:
    """Return the highest degree at which harmonics ``[n,k-1,3]`` are not all zero."""
    used = np.flatnonzero(harmonics.any((0, 2)))
    return int(np.sqrt(used[-1] + 1)) if len(used) else 0
