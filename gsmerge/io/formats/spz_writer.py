"""``.spz`` version 3: a gzip stream of quantised columns (github.com/nianticlabs/spz, README and load-spz.cc).

Positions are fixed-point numbers of 24 bits, log scales steps of 1/16 from -10 on, opacities and colours bytes,
rotations their three smaller components with sign and 9 bits each, harmonics bytes of which 5 (degree 1) or 4 bits are
used.

The README says that axes are right, up and back. The converters that come with it, splat-transform and SuperSplat all
keep those of the ``.ply`` instead, and so does this: the file shows what the ``.ply`` shows.
"""

from __future__ import annotations

import gzip
import struct

import numpy as np

from gsmerge.io.formats.arrays import smallest_three, to_bytes, to_columns
from gsmerge.types import SH_C0, Gaussians

MAX_DEGREE = 3  # older readers do not know degree 4
MAGIC, VERSION = 0x5053474E, 3
HEADER = struct.Struct("<IIIBBBB")  # magic, version, count, SH degree, fraction bits, flags, zero
MIP_FLAG = 1  # the Gaussians want to be rendered with a filter of their own
FINE = 14  # bits of a position within the scene: a sixteenth of a pixel where it fills a thousand
MAX_FRACTION = 23
LARGEST = 2**23 - 1
COLOR_SCALE = 0.15  # of sh0: colours somewhat outside [0, 1] survive


def spz_bytes(gaussians: Gaussians, *, mip: bool = False) -> bytes:
    """Content of a ``.spz`` file; ``mip`` sets the flag of antialiased Gaussians. ValueError if there is NaN or inf."""
    columns = to_columns(gaussians, MAX_DEGREE)
    degree = round((columns.harmonics.shape[1] + 1) ** 0.5) - 1
    fraction = _fraction_bits(columns.means)
    header = HEADER.pack(MAGIC, VERSION, len(columns), degree, fraction, MIP_FLAG * mip, 0)
    fixed = np.clip(np.round(columns.means * 2.0**fraction), -LARGEST, LARGEST).astype("<i4")
    parts = [
        fixed.view(np.uint8).reshape(-1, 4)[:, :3].tobytes(),  # three little-endian bytes for each coordinate
        to_bytes(255 * columns.opacities).tobytes(),
        to_bytes(255 * (COLOR_SCALE * (columns.colors - 0.5) / SH_C0 + 0.5)).tobytes(),
        to_bytes(16 * (columns.log_scales + 10)).tobytes(),
        _rotations(columns.quats),
        _harmonics(columns.harmonics),
    ]
    return gzip.compress(header + b"".join(parts), mtime=0)  # the same bytes at any time


def _fraction_bits(means: np.ndarray) -> int:
    """Bits behind the point: as many as the scene's size asks for and its farthest Gaussian leaves."""
    if len(means) == 0:
        return 0
    size = np.median(np.abs(means - np.median(means, axis=0)).max(axis=1))
    fine = FINE - np.log2(max(size, 1e-6))
    left = np.log2(LARGEST / max(np.abs(means).max(), 1e-6))
    return int(np.clip(min(np.ceil(fine), np.floor(left)), 0, MAX_FRACTION))


def _rotations(quats: np.ndarray) -> bytes:
    """32 bits each: index of the largest component of xyzw, then sign and magnitude of the others, first one on top."""
    largest, others = smallest_three(np.roll(quats, -1, axis=1))
    parts = np.minimum(np.floor(511 * np.abs(others) * np.sqrt(2.0) + 0.5), 511).astype(np.uint32)
    parts |= (others < 0).astype(np.uint32) << np.uint32(9)
    words = largest.astype(np.uint32) << np.uint32(30)
    for i, shift in enumerate((20, 10, 0)):
        words |= parts[:, i] << np.uint32(shift)
    return words.astype("<u4").tobytes()


def _harmonics(harmonics: np.ndarray) -> bytes:
    """Bytes 128 + 128 x, rounded to steps of 8 for degree 1 and of 16 above."""
    steps = np.where(np.arange(harmonics.shape[1]) < 3, 8, 16)[:, None]
    values = np.round(np.clip(harmonics, -2, 2) * 128) + 128
    return np.clip((values + steps // 2) // steps * steps, 0, 255).astype(np.uint8).tobytes()
