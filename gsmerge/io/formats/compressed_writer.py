"""Writing compressed PLY; :mod:`gsmerge.io.formats.compressed` has the layout."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmerge.geometry import morton_codes
from gsmerge.io.formats.arrays import columns_of, smallest_three, to_bytes
from gsmerge.io.formats.compressed import CHUNK, COLORS, PACKED, RANGES, SH_RANGE
from gsmerge.types import Gaussians

MAX_DEGREE = 3


def compressed_bytes(gaussians: Gaussians, comments: Sequence[str] = ()) -> bytes:
    """Content of a ``.compressed.ply``; rows along a space-filling curve, so that chunks are small.

    Raises:
        ValueError: If there is NaN or inf.
    """
    columns = columns_of(gaussians, MAX_DEGREE)
    columns = columns.taken(np.argsort(morton_codes(columns.means), kind="stable"))
    count, num_rest = len(columns), 3 * columns.harmonics.shape[1]
    low_means, high_means, means = _ranged(columns.means)
    low_scales, high_scales, scales = _ranged(columns.log_scales)
    low_colors, high_colors, colors = _ranged(columns.colors)
    chunks = np.concatenate([low_means, high_means, low_scales, high_scales, low_colors, high_colors], 1)
    words = np.empty((count, 4), "<u4")
    words[:, 0], words[:, 2] = _packed(means, (11, 10, 11)), _packed(scales, (11, 10, 11))
    largest, others = smallest_three(columns.quats)
    words[:, 1] = largest.astype(np.uint32) << np.uint32(30) | _packed(others / np.sqrt(2.0) + 0.5, (10, 10, 10))
    words[:, 3] = _packed(np.concatenate([colors, columns.opacities[:, None]], 1), (8, 8, 8, 8))
    harmonics = to_bytes(
        np.floor((columns.harmonics / SH_RANGE + 0.5) * 256).transpose(0, 2, 1).reshape(count, num_rest)
    )
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    header += [f"element chunk {len(chunks)}", *(f"property float {name}" for name in (*RANGES, *COLORS))]
    header += [f"element vertex {count}", *(f"property uint {name}" for name in PACKED)]
    if num_rest:
        header += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(num_rest))]
    text = "\n".join([*header, "end_header", ""])
    return text.encode("ascii") + chunks.astype("<f4").tobytes() + words.tobytes() + harmonics.tobytes()


def _ranged(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least and largest values ``[c,3]`` of every chunk, as float32 holds them, and all values between 0 and 1."""
    starts = np.arange(0, len(values), CHUNK)
    if len(starts) == 0:
        return values, values, values
    low, high = (
        reduce.reduceat(values, starts).astype(np.float32).astype(np.float64) for reduce in (np.minimum, np.maximum)
    )
    ids, span = np.arange(len(values)) // CHUNK, high - low
    return low, high, (values - low[ids]) / np.where(span > 0, span, 1)[ids]


def _packed(shares: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Numbers between 0 and 1 side by side in a word, the first one on top."""
    words = np.zeros(len(shares), np.uint32)
    for column, width in zip(shares.T, bits, strict=True):
        top = 2**width - 1
        words = words << np.uint32(width) | np.clip(np.floor(column * top + 0.5), 0, top).astype(np.uint32)
    return words
