"""Read compressed PLY files of PlayCanvas, SuperSplat and gsplat.

Each Gaussian has four packed words. Each chunk of 256 Gaussians stores the bounds of their positions and scales, and
may store those of their colours.

The layout is that of PlayCanvas' reader. The x, y and z of positions and scales have 11, 10 and 11 bits, and range from
a chunk's minimum to its maximum. Rotations are the three smaller components of quaternions at 10 bits. Colours and
opacities have 8 bits. Harmonics are bytes in the element ``sh``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.formats import rows as arrays
from gsmerge.io.formats.rows import PACKED
from gsmerge.method.geometry.transforms import rgb_to_sh0
from gsmerge.method.kernels.elementary import log, log1p

if TYPE_CHECKING:
    from gsmerge.io.formats.ply import Element

CHUNK = 256  # Gaussians in a chunk
_POSITION_RANGES = tuple(f"{bound}_{axis}" for bound in ("min", "max") for axis in "xyz")
_SCALE_RANGES = tuple(f"{bound}_scale_{axis}" for bound in ("min", "max") for axis in "xyz")
# Columns that a chunk must have. The columns COLOR_RANGES may be missing
RANGE_COLUMNS = (*_POSITION_RANGES, *_SCALE_RANGES)
COLOR_RANGES = tuple(f"{bound}_{channel}" for bound in ("min", "max") for channel in "rgb")
SH_RANGE = 8.0  # bytes of harmonics span -4 to 4
# Harmonic of each stored byte
_HARMONICS = (np.r_[0, (np.arange(1, 255) + 0.5) / 256, 1].astype(np.float32) - 0.5) * SH_RANGE


def packed_rows(path: Path, elements: Mapping[str, Element]) -> arrays.PackedRows:
    """Return the rows of a compressed PLY as rows of an ordinary PLY, with opacities as logits."""
    vertex = elements["vertex"]
    chunk = elements["chunk"]
    _check_types(path, vertex, PACKED, ("u4", "i4"))
    _check_types(path, chunk, RANGE_COLUMNS, ("f4", "f8"))
    count = vertex.count
    num_chunks = -(-vertex.count // CHUNK)
    if count == 0:
        raise SceneError(path, "expected at least one Gaussian, found 0 vertices", "export it again")
    if chunk.count < num_chunks:
        problem = f"expected {num_chunks} chunks for {count} Gaussians, found {chunk.count}"
        raise SceneError(path, problem, "export it again")
    num_rest = 0  # columns of harmonics above degree 0
    if "sh" in elements:
        row_type = elements["sh"].rows.dtype
        names = {name for name in row_type.names or () if row_type[name] == np.uint8}
        num_rest = len(names)
        are_whole_degrees = num_rest in (9, 24, 45) and names == {f"f_rest_{i}" for i in range(num_rest)}
        if not are_whole_degrees or elements["sh"].count != count:
            problem = f"expected 9, 24 or 45 harmonics of {count} Gaussians in element 'sh', found others"
            raise SceneError(path, problem, "export it again")
    ranges = chunk.rows[:]

    def unpack(block: slice) -> arrays.Columns:
        """Unpack the Gaussians of a block of rows, with opacities as logits."""
        codes = np.empty((block.stop - block.start, num_rest), np.uint8)
        harmonics = elements["sh"].rows[block] if num_rest else codes
        for i in range(num_rest):
            codes[:, i] = harmonics[f"f_rest_{i}"]
        rows = vertex.rows[block]
        words = {name: rows[name].astype(np.uint32) for name in PACKED}
        chunk_ids = np.arange(block.start, block.stop) // CHUNK
        *colors, alpha = _unpack_words(words["packed_color"], (8, 8, 8, 8))
        largest = (words["packed_rotation"] >> np.uint32(30)).astype(np.int64)  # index of a component of wxyz
        smallest = np.stack(_unpack_words(words["packed_rotation"], (10, 10, 10)), 1) - 0.5  # within +-sqrt(1/2)
        positions, scales = (_unpack_words(words[name], (11, 10, 11)) for name in ("packed_position", "packed_scale"))
        return arrays.Columns(
            means=_interpolate(positions, ranges, _POSITION_RANGES, chunk_ids),
            quats=arrays.from_smallest_three(largest, smallest * np.sqrt(2.0)),
            log_scales=_interpolate(scales, ranges, _SCALE_RANGES, chunk_ids),
            opacities=log(alpha) - log1p(-alpha),  # infinite for 0 and 1, which the reader accepts
            sh0=rgb_to_sh0(_interpolate(colors, ranges, COLOR_RANGES, chunk_ids)),
            harmonics=_HARMONICS[codes.reshape(len(rows), 3, -1).transpose(0, 2, 1)],
        )

    return arrays.pack_rows([arrays.Packed(count, num_rest // 3, unpack)])


def _check_types(path: Path, element: Element, columns: tuple[str, ...], types: tuple[str, str]) -> None:
    """Raise SceneError if an element lacks one of ``columns``, or stores it in a type that is not in ``types``."""
    row_type = element.rows.dtype
    stored = {name: row_type[name].str[1:] for name in row_type.names or ()}  # of an element without lists
    wrong = next((name for name in columns if stored.get(name) not in types), None)
    if wrong is not None:
        place = f"in element '{element.name}' of a compressed file"
        found = stored.get(wrong, "none")
        raise SceneError(path, f"expected {wrong} {place} as {types[0]}, found {found}", "export it again")


def _interpolate(
    weights: list[np.ndarray], chunk: np.ndarray, ranges: tuple[str, ...], chunk_ids: np.ndarray
) -> np.ndarray:
    """Interpolate from the minimum to the maximum of each Gaussian's chunk; return values ``[n,3]``.

    ``weights``: three arrays ``[n]`` of weights of the maximum, in [0, 1]. If the file lacks the columns ``ranges``,
    the weights are returned. ``ranges``: names of the three columns with minima, then of those with maxima. ``chunk_ids
    [n]``: the chunk of each Gaussian.
    """
    if all(name in (chunk.dtype.names or ()) and chunk.dtype[name].kind == "f" for name in ranges):
        bounds = [chunk[name][chunk_ids].astype(np.float32) for name in ranges]
        weights = [
            low * (1 - weight) + high * weight
            for weight, low, high in zip(weights, bounds[:3], bounds[3:], strict=True)
        ]
    return np.stack(weights, 1)


def _unpack_words(words: np.ndarray, bits: tuple[int, ...]) -> list[np.ndarray]:
    """Unpack several numbers in [0, 1] from each word, the first number from the highest of the used bits.

    ``bits``: how many bits each number has.
    """
    out = []
    for i, width in enumerate(bits):
        shifted = words >> np.uint32(sum(bits[i + 1 :]))
        out.append((shifted & np.uint32(2**width - 1)) / float(2**width - 1))
    return out
