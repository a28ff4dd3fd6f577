"""Reading ``.spz`` versions 1 to 3: a gzip stream of quantised columns (:mod:`gsmerge.io.formats.spz_writer`).

Version 1 has positions of 16-bit floats; rotations of versions 1 and 2 are three bytes, x, y and z of a quaternion
whose w is positive.
"""

from __future__ import annotations

import zlib
from itertools import pairwise
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry import rgb_to_sh0
from gsmerge.io.bounds import check_file
from gsmerge.io.formats.arrays import Columns, StoredRows, from_smallest_three, to_rows
from gsmerge.io.formats.spz_writer import COLOR_SCALE, HEADER, MAGIC, MAX_DEGREE, MIP_FLAG
from gsmerge.types import SH_C0

VERSIONS = (1, 2, 3)
ATTRIBUTES = ("means", "opacities", "sh0", "scales", "quats", "shN")  # in the order of the stream
MAX_RATIO = 1032  # of gzip: no stream unpacks to more


def read_rows(path: Path) -> StoredRows:
    """The Gaussians of a ``.spz``. SceneError if it is none, of another version, truncated or damaged."""
    check_file(path)
    try:
        packed = path.read_bytes()
    except OSError as error:
        raise SceneError(path, f"cannot be read ({error.strerror})") from error
    if packed[:4] == MAGIC.to_bytes(4, "little"):
        raise SceneError(path, "expected .spz of version 1 to 3, found a later one", "export it as version 3")
    stream = zlib.decompressobj(wbits=31)
    try:
        header = stream.decompress(packed, HEADER.size)
        if len(header) < HEADER.size:
            raise SceneError(path, "expected a .spz file, found an early end of file", "copy or export it again")
        magic, version, count, degree, fraction, flags, _ = HEADER.unpack(header)
        if magic != MAGIC or version not in VERSIONS or degree > MAX_DEGREE or fraction > 30:
            numbers = f"version {version}, SH degree {degree}" if magic == MAGIC else "another file"
            raise SceneError(path, f"expected .spz of version 1 to 3 and SH degree 0 to 3, found {numbers}")
        widths = _widths(version, degree)
        total = count * sum(widths)
        if count == 0 or total > MAX_RATIO * len(packed):
            raise SceneError(path, f"expected Gaussians in {len(packed)} bytes, found {count} promised")
        data = stream.decompress(stream.unconsumed_tail, total)
    except zlib.error as error:
        raise SceneError(path, "expected a gzip stream of .spz, found another or damaged file") from error
    if len(data) < total:
        problem = f"truncated or damaged: expected {total} bytes for {count} Gaussians, found {len(data)}"
        raise SceneError(path, problem, "copy or export it again")
    ends = np.cumsum([0, *widths]) * count
    parts = [np.frombuffer(data, np.uint8, end - at, at).reshape(count, -1) for at, end in pairwise(ends)]
    sizes = {name: part.size for name, part in zip(ATTRIBUTES, parts, strict=True) if part.size}
    return to_rows(_columns(parts, version, fraction), f".spz version {version}", sizes, mip=bool(flags & MIP_FLAG))


def _widths(version: int, degree: int) -> tuple[int, ...]:
    """Bytes per Gaussian of the attributes."""
    return 6 if version == 1 else 9, 1, 3, 3, 4 if version == 3 else 3, 3 * ((degree + 1) ** 2 - 1)


def _columns(parts: list[np.ndarray], version: int, fraction: int) -> Columns:
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
