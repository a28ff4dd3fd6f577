"""Reading ``.spz`` versions 1 to 4: quantised columns (:mod:`gsmerge.io.formats.spz_writer`).

Version 1 has positions of 16-bit floats; rotations of versions 1 and 2 are three bytes, x, y and z of a quaternion
whose w is positive.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry import rgb_to_sh0
from gsmerge.io.bounds import check_file
from gsmerge.io.formats.arrays import Columns, StoredRows, from_smallest_three, to_rows
from gsmerge.io.formats.spz_writer import (
    COLOR_SCALE,
    HEADER,
    MAGIC,
    MIP_FLAG,
    TABLE_ROW,
    TABLE_START,
    zstandard,
)
from gsmerge.types import SH_C0

ATTRIBUTES = ("means", "opacities", "sh0", "scales", "quats", "shN")  # in the order of the file
MAX_DEGREE = 4  # which some write as version 3, too
MAX_RATIO = 1032  # of gzip: no stream unpacks to more; nor do the columns of version 4 together, of any scene
FOUND_EARLY_END = "expected a .spz file, found an early end of file"
AGAIN = "copy or export it again"


@dataclass(frozen=True)
class _Header:
    version: int
    count: int
    degree: int
    fraction: int
    flags: int
    num_streams: int  # of version 4

    @property
    def widths(self) -> tuple[int, ...]:
        """Bytes per Gaussian of the attributes."""
        harmonics = 3 * ((self.degree + 1) ** 2 - 1)
        return 6 if self.version == 1 else 9, 1, 3, 3, 4 if self.version > 2 else 3, harmonics


def read_rows(path: Path) -> StoredRows:
    """The Gaussians of a ``.spz``.

    Raises:
        SceneError: If it is none, of another version, truncated or damaged.
        UsageError: If it is of version 4 and ``zstandard`` is not installed.
    """
    check_file(path)
    try:
        packed = path.read_bytes()
    except OSError as error:
        raise SceneError(path, f"cannot be read ({error.strerror})") from error
    read = _zstandard_parts if packed[:4] == MAGIC.to_bytes(4, "little") else _gzip_parts
    header, parts = read(path, packed)
    sizes = {name: part.size for name, part in zip(ATTRIBUTES, parts, strict=True) if part.size}
    mip = bool(header.flags & MIP_FLAG)
    return to_rows(_columns(parts, header), f".spz version {header.version}", sizes, mip=mip)


def _read_header(path: Path, packed: bytes, start: bytes, versions: Sequence[int]) -> _Header:
    """The header, checked against the bytes of the file."""
    if len(start) < HEADER.size:
        raise SceneError(path, FOUND_EARLY_END, AGAIN)
    magic, *numbers = HEADER.unpack(start)
    header = _Header(*numbers)
    if magic != MAGIC or header.version not in versions or header.degree > MAX_DEGREE or header.fraction > 30:
        found = f"version {header.version}, SH degree {header.degree}" if magic == MAGIC else "another file"
        raise SceneError(path, f"expected .spz of version 1 to 4 and SH degree 0 to {MAX_DEGREE}, found {found}")
    if header.count == 0 or header.count * sum(header.widths) > MAX_RATIO * len(packed):
        raise SceneError(path, f"expected Gaussians in {len(packed)} bytes, found {header.count} promised")
    return header


def _gzip_parts(path: Path, packed: bytes) -> tuple[_Header, list[np.ndarray]]:
    stream = zlib.decompressobj(wbits=31)
    try:
        header = _read_header(path, packed, stream.decompress(packed, HEADER.size), (1, 2, 3))
        data = stream.decompress(stream.unconsumed_tail, header.count * sum(header.widths))
    except zlib.error as error:
        raise SceneError(path, "expected a gzip stream of .spz, found another or damaged file") from error
    ends = np.cumsum([0, *header.widths]) * header.count
    if len(data) < ends[-1]:
        problem = f"truncated or damaged: expected {ends[-1]} bytes for {header.count} Gaussians, found {len(data)}"
        raise SceneError(path, problem, AGAIN)
    parts = [np.frombuffer(data, np.uint8, end - at, at).reshape(header.count, -1) for at, end in pairwise(ends)]
    return header, parts


def _zstandard_parts(path: Path, packed: bytes) -> tuple[_Header, list[np.ndarray]]:
    """Those of version 4. Extensions, which lie between header and table, say nothing about the Gaussians."""
    header = _read_header(path, packed, packed[: HEADER.size], (4,))
    sizes = [header.count * width for width in header.widths if width]
    try:
        (at,) = TABLE_START.unpack_from(packed, HEADER.size)
        table = [TABLE_ROW.unpack_from(packed, at + i * TABLE_ROW.size) for i in range(header.num_streams)]
    except struct.error as error:
        raise SceneError(path, FOUND_EARLY_END, AGAIN) from error
    if [row[1] for row in table] != sizes:
        problem = f"damaged: expected columns of {sizes} bytes for {header.count} Gaussians, found others"
        raise SceneError(path, problem, AGAIN)
    ends = at + len(table) * TABLE_ROW.size + np.cumsum([0, *(row[0] for row in table)], dtype=object)
    if ends[-1] > len(packed):
        problem = f"truncated or damaged: expected {ends[-1]} bytes for {header.count} Gaussians, found {len(packed)}"
        raise SceneError(path, problem, AGAIN)
    library = zstandard()
    unpacker = library.ZstdDecompressor()
    try:  # one byte more than expected at most, whatever a stream says of its size
        columns = [
            unpacker.stream_reader(packed[i:j]).read(size + 1)
            for (i, j), size in zip(pairwise(ends), sizes, strict=True)
        ]
    except library.ZstdError as error:
        raise SceneError(path, "damaged: expected Zstandard streams of .spz version 4, found others", AGAIN) from error
    if [len(column) for column in columns] != sizes:
        raise SceneError(path, "truncated or damaged: a column of .spz version 4 is of another size", AGAIN)
    columns += [b""] * (len(header.widths) - len(columns))
    return header, [np.frombuffer(column, np.uint8).reshape(header.count, -1) for column in columns]


def _columns(parts: list[np.ndarray], header: _Header) -> Columns:
    version, fraction = header.version, header.fraction
    means, opacities, colors, scales, rotations, harmonics = parts
    return Columns(
        means=means.view("<f2").astype(float) if version == 1 else _fixed_points(means) / 2.0**fraction,
        quats=_three_bytes(rotations) if version < 3 else _smallest_three(rotations.view("<u4")[:, 0]),
        log_scales=scales / 16 - 10,
        opacities=opacities[:, 0] / 255,
        sh0=rgb_to_sh0(0.5 + SH_C0 * (colors / 255 - 0.5) / COLOR_SCALE),
        harmonics=(harmonics.reshape(len(harmonics), -1, 3) - 128.0) / 128,
    )


def _fixed_points(stored: np.ndarray) -> np.ndarray:
    """``[n,3]`` signed numbers of three little-endian bytes each."""
    words = np.zeros((len(stored), 3, 4), np.uint8)
    words[..., 1:] = stored.reshape(-1, 3, 3)
    return words.view("<i4")[..., 0] >> 8


def _three_bytes(stored: np.ndarray) -> np.ndarray:
    xyz = stored / 127.5 - 1
    w = np.sqrt(np.clip(1 - (xyz**2).sum(1, keepdims=True), 0, None))
    return np.concatenate([w, xyz], 1)


def _smallest_three(words: np.ndarray) -> np.ndarray:
    """Quaternions wxyz of words whose top two bits name the largest of xyzw; see the writer."""
    parts = np.stack([words >> np.uint32(shift) & np.uint32(1023) for shift in (20, 10, 0)], 1)
    others = np.where(parts & 512, -1.0, 1.0) * (parts & 511) / (511 * np.sqrt(2.0))
    return np.roll(from_smallest_three((words >> np.uint32(30)).astype(int), others), 1, axis=1)
