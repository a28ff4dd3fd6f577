"""gsmerge reads these files and no longer writes them: packed ``.ply`` of PlayCanvas, ``.spz`` of version 4."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from gsmerge.io.formats import rows as arrays
from gsmerge.io.formats.compressed import CHUNK, COLOR_RANGES, RANGE_COLUMNS, SH_RANGE
from gsmerge.io.formats.spz import HEADER, MAGIC, MIP_FLAG, spz_columns
from gsmerge.types import Gaussians


def spz4_bytes(gaussians: Gaussians, *, mip: bool = False) -> bytes:
    """Return a ``.spz`` of version 4: a clear header, a table of sizes, and a Zstandard stream for each column."""
    import zstandard

    header, columns = spz_columns(gaussians, 4, mip=mip)
    *_, count, degree, fraction, _, _ = HEADER.unpack(header)
    parts = [part.tobytes() for part in columns if part.shape[1]]
    packed = [zstandard.ZstdCompressor(level=12).compress(part) for part in parts]
    sizes = [struct.pack("<QQ", len(short), len(part)) for short, part in zip(packed, parts, strict=True)]
    header = HEADER.pack(MAGIC, 4, count, degree, fraction, MIP_FLAG * mip, len(parts))
    return b"".join([header, struct.pack("<I12x", 32), *sizes, *packed])


def compressed_bytes(gaussians: Gaussians, comments: Sequence[str] = ()) -> bytes:
    """Return a ``.compressed.ply``: four words for a Gaussian, between the ends of 256 neighbours along a curve."""
    columns = arrays.to_columns(gaussians, 3).along_curve()
    count, num_rest = len(columns), 3 * columns.harmonics.shape[1]
    ranged = [_ranged(values) for values in (columns.means, columns.log_scales, columns.colors)]
    chunks = np.concatenate([end for low, high, _ in ranged for end in (low, high)], 1)
    means, scales, colors = (shares for _, _, shares in ranged)
    words = np.empty((count, 4), "<u4")
    words[:, 0], words[:, 2] = _packed(means, (11, 10, 11)), _packed(scales, (11, 10, 11))
    largest, smallest = arrays.smallest_three(columns.quats)
    words[:, 1] = largest.astype(np.uint32) << np.uint32(30) | _packed(smallest / np.sqrt(2.0) + 0.5, (10, 10, 10))
    words[:, 3] = _packed(np.concatenate([colors, columns.opacities[:, None]], 1), (8, 8, 8, 8))
    harmonics = np.floor((columns.harmonics / SH_RANGE + 0.5) * 256).transpose(0, 2, 1)
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    header += [f"element chunk {len(chunks)}", *(f"property float {name}" for name in (*RANGE_COLUMNS, *COLOR_RANGES))]
    header += [f"element vertex {count}", *(f"property uint {name}" for name in arrays.PACKED)]
    if num_rest:
        header += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(num_rest))]
    text = "\n".join([*header, "end_header", ""]).encode("ascii")
    return text + chunks.astype("<f4").tobytes() + words.tobytes() + arrays.to_bytes(harmonics).tobytes()


def _ranged(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the float32 minima and maxima ``[c,3]`` of each chunk, and all values between 0 and 1."""
    starts = np.arange(0, len(values), CHUNK)
    low, high = (end.reduceat(values, starts).astype(np.float32).astype(float) for end in (np.minimum, np.maximum))
    ids, span = np.arange(len(values)) // CHUNK, high - low
    return low, high, (values - low[ids]) / np.where(span > 0, span, 1)[ids]


def _packed(shares: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Return words of numbers between 0 and 1; the first number is in the highest bits."""
    words = np.zeros(len(shares), np.uint32)
    for column, width in zip(shares.T, bits, strict=True):
        top = 2**width - 1
        words = words << np.uint32(width) | np.clip(np.floor(column * top + 0.5), 0, top).astype(np.uint32)
    return words
