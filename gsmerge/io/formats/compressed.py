"""Compressed PLY (PlayCanvas, SuperSplat, gsplat): four packed words per Gaussian, ranges per chunk of 256.

The layout is that of PlayCanvas' reader: positions and scales 11-10-11 bits between a chunk's minimum and maximum,
rotations as their three smaller components at 10 bits, colours and opacity at 8 bits, harmonics as bytes in ``sh``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyListProperty

from gsmerge.errors import SceneError
from gsmerge.geometry import rgb_to_sh0
from gsmerge.io.formats import arrays
from gsmerge.io.formats.arrays import PACKED
from gsmerge.kernels.elementary import log, log1p
from gsmerge.types import Gaussians

CHUNK = 256  # Gaussians that share a range
RANGES = (
    *(f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"),
    *(f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"),
)
COLORS = tuple(f"{end}_{channel}" for end in ("min", "max") for channel in "rgb")
SH_RANGE = 8.0  # bytes of harmonics span -4 to 4
_HARMONICS = (np.r_[0, (np.arange(1, 255) + 0.5) / 256, 1].astype(np.float32) - 0.5) * SH_RANGE  # of each byte
MAX_DEGREE = 3  # of the harmonics that are written


def packed_rows(path: Path, data: PlyData) -> arrays.PackedRows:
    """Return the rows of a compressed PLY as rows of an ordinary PLY, with opacities as logits."""
    vertex, chunk = data["vertex"], data["chunk"]
    for element, needed, types in ((vertex, PACKED, ("u4", "i4")), (chunk, RANGES, ("f4", "f8"))):
        dtypes = {p.name: p.val_dtype for p in element.properties if not isinstance(p, PlyListProperty)}
        odd = next((name for name in needed if dtypes.get(name) not in types), None)
        if odd is not None:
            where, kind = f"in element '{element.name}' of a compressed file", dtypes.get(odd, "none")
            raise SceneError(path, f"expected {odd} {where} as {types[0]}, found {kind}")
    count, num_chunks = vertex.count, -(-vertex.count // CHUNK)
    if count == 0:
        raise SceneError(path, "expected at least one Gaussian, found 0 vertices")
    if chunk.count < num_chunks:
        problem = f"expected {num_chunks} chunks for {count} Gaussians, found {chunk.count}"
        raise SceneError(path, problem, "export it again")
    num_higher = _num_rest(path, data, count) // 3
    return arrays.pack_rows([arrays.Packed(count, num_higher, lambda block: _unpack(data, num_higher, block))])


def _unpack(data: PlyData, num_higher: int, block: slice) -> arrays.Columns:
    vertex, chunk = data["vertex"].data[block], data["chunk"].data
    words = {name: vertex[name].astype(np.uint32) for name in PACKED}
    ids = np.arange(block.start, block.stop) // CHUNK
    *colors, alpha = _shares(words["packed_color"], (8, 8, 8, 8))
    largest = (words["packed_rotation"] >> np.uint32(30)).astype(np.int64)  # of wxyz
    smallest = np.stack(_shares(words["packed_rotation"], (10, 10, 10)), 1) - 0.5  # within +-sqrt(1/2)
    codes = np.empty((len(vertex), 3 * num_higher), np.uint8)
    for i in range(3 * num_higher):
        codes[:, i] = data["sh"].data[f"f_rest_{i}"][block]
    return arrays.Columns(
        means=_between(_shares(words["packed_position"], (11, 10, 11)), chunk, RANGES[:6], ids),
        quats=arrays.from_smallest_three(largest, smallest * np.sqrt(2.0)),
        log_scales=_between(_shares(words["packed_scale"], (11, 10, 11)), chunk, RANGES[6:], ids),
        opacities=log(alpha) - log1p(-alpha),  # infinite for 0 and 1, which the reader takes as such
        sh0=rgb_to_sh0(_between(colors, chunk, COLORS, ids)),
        harmonics=_HARMONICS[codes.reshape(len(vertex), 3, num_higher).transpose(0, 2, 1)],
    )


def _num_rest(path: Path, data: PlyData, count: int) -> int:
    if "sh" not in data:
        return 0
    names = {p.name for p in data["sh"].properties if p.dtype() == "=u1"}
    number = len(names)
    if number not in (9, 24, 45) or names != {f"f_rest_{i}" for i in range(number)} or data["sh"].count != count:
        raise SceneError(path, f"expected 9, 24 or 45 harmonics for {count} Gaussians in element 'sh', found others")
    return number


def _between(shares: list[np.ndarray], chunk: np.ndarray, ranges: tuple[str, ...], ids: np.ndarray) -> np.ndarray:
    """Return ``[n,3]`` numbers from shares between the least and largest values of chunks, or shares without these."""
    if all(name in (chunk.dtype.names or ()) and chunk.dtype[name].kind == "f" for name in ranges):
        ends = [chunk[name][ids].astype(np.float32) for name in ranges]
        shares = [low * (1 - share) + high * share for share, low, high in zip(shares, ends, ends[3:], strict=False)]
    return np.stack(shares, 1)


def _shares(words: np.ndarray, bits: tuple[int, ...]) -> list[np.ndarray]:
    """Unpack numbers between 0 and 1 from words; the last number is in the lowest bits."""
    out = []
    for i, width in enumerate(bits):
        shifted = words >> np.uint32(sum(bits[i + 1 :]))
        out.append((shifted & np.uint32(2**width - 1)) / float(2**width - 1))
    return out


def compressed_bytes(gaussians: Gaussians, comments: Sequence[str] = ()) -> bytes:
    """Encode a ``.compressed.ply`` file along a space-filling curve; ValueError if there is NaN or inf."""
    columns = arrays.to_columns(gaussians, MAX_DEGREE).along_curve()
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
    header += [f"element chunk {len(chunks)}", *(f"property float {name}" for name in (*RANGES, *COLORS))]
    header += [f"element vertex {count}", *(f"property uint {name}" for name in PACKED)]
    if num_rest:
        header += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(num_rest))]
    text = "\n".join([*header, "end_header", ""])
    return (
        text.encode("ascii") + chunks.astype("<f4").tobytes() + words.tobytes() + arrays.to_bytes(harmonics).tobytes()
    )


def _ranged(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the float32 minima and maxima ``[c,3]`` of each chunk, and all values between 0 and 1."""
    starts = np.arange(0, len(values), CHUNK)
    low, high = (end.reduceat(values, starts).astype(np.float32).astype(float) for end in (np.minimum, np.maximum))
    ids, span = np.arange(len(values)) // CHUNK, high - low
    return low, high, (values - low[ids]) / np.where(span > 0, span, 1)[ids]


def _packed(shares: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Pack numbers between 0 and 1 into words; the first number is in the highest bits."""
    words = np.zeros(len(shares), np.uint32)
    for column, width in zip(shares.T, bits, strict=True):
        top = 2**width - 1
        words = words << np.uint32(width) | np.clip(np.floor(column * top + 0.5), 0, top).astype(np.uint32)
    return words
