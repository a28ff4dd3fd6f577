"""``.spz``: quantised columns (github.com/nianticlabs/spz, README and load-spz.cc).

Positions are fixed-point numbers of 24 bits, log scales steps of 1/16 from -10 on, opacities and colours bytes,
rotations their three smaller components with sign and 9 bits each, harmonics bytes of which 5 (degree 1) or 4 bits are
used. Version 3 is one gzip stream, with harmonics up to degree 3; version 4 has a header in the clear, a table of
compressed and uncompressed sizes, and one Zstandard stream for each column.

The README says that axes are right, up and back. The converters that come with it, splat-transform and SuperSplat all
keep those of the ``.ply`` instead, and so does this: the file shows what the ``.ply`` shows.
"""

from __future__ import annotations

import gzip
import struct
from dataclasses import dataclass
from types import ModuleType

import numpy as np

from gsmerge.errors import UsageError
from gsmerge.io.formats.arrays import smallest_three, to_bytes, to_columns
from gsmerge.types import SH_C0, Gaussians

VERSIONS = (3, 4)  # that are written; Spark 2.2 does not read 4
MAX_DEGREES = {3: 3, 4: 4}  # of the harmonics, by version
MAGIC = 0x5053474E
HEADER = struct.Struct("<IIIBBBB")  # magic, version, count, SH degree, fraction bits, flags; zero, or number of streams
TABLE_START = struct.Struct("<I12x")  # where the table of version 4 begins, in bytes from the file's start
TABLE_ROW = struct.Struct("<QQ")  # bytes of a stream: compressed, uncompressed
MIP_FLAG = 1  # the Gaussians want to be rendered with a filter of their own
FINE = 14  # bits of a position within the scene: a sixteenth of a pixel where it fills a thousand
MAX_FRACTION = 23
ZSTD_LEVEL = 12
INSTALL = 'pip install "zstandard>=0.23,<1"'  # as the extra spz4 asks for; works beside a wheel and in a checkout
LARGEST = 2**23 - 1
COLOR_SCALE = 0.15  # of sh0: colours somewhat outside [0, 1] survive


@dataclass(frozen=True)
class SpzColumns:
    """What a ``.spz`` holds of n Gaussians: ``parts`` are ``[n,bytes]`` uint8 in the order of the file."""

    count: int
    degree: int  # of the harmonics
    fraction: int  # bits of a position behind the point
    mip: bool
    parts: tuple[np.ndarray, ...]

    def header(self, version: int) -> bytes:
        """The first 16 bytes, of version 3 before gzip."""
        last = len(self.streams) if version == 4 else 0
        return HEADER.pack(MAGIC, version, self.count, self.degree, self.fraction, MIP_FLAG * self.mip, last)

    @property
    def streams(self) -> list[bytes]:
        """The parts as bytes, without that of harmonics where there are none."""
        return [part.tobytes() for part in self.parts if part.shape[1]]


def spz_columns(gaussians: Gaussians, max_degree: int, *, mip: bool = False, fine: int = FINE) -> SpzColumns:
    """Gaussians quantised; ``fine`` is the number of bits of a position within the scene.
    ValueError if there is NaN or inf.
    """
    columns = to_columns(gaussians, max_degree)
    fraction = _fraction_bits(columns.means, fine)
    fixed = np.clip(np.round(columns.means * 2.0**fraction), -LARGEST, LARGEST).astype("<i4")
    parts = (
        fixed.view(np.uint8).reshape(-1, 3, 4)[..., :3].reshape(-1, 9),  # three little-endian bytes a coordinate
        to_bytes(255 * columns.opacities)[:, None],
        to_bytes(255 * (COLOR_SCALE * (columns.colors - 0.5) / SH_C0 + 0.5)),
        to_bytes(16 * (columns.log_scales + 10)),
        _rotations(columns.quats),
        _harmonics(columns.harmonics),
    )
    degree = round((columns.harmonics.shape[1] + 1) ** 0.5) - 1
    return SpzColumns(len(columns), degree, fraction, mip, parts)


def spz_bytes(gaussians: Gaussians, *, mip: bool = False, version: int = 3) -> bytes:
    """Content of a ``.spz`` file; ``mip`` sets the flag of antialiased Gaussians.

    Raises:
        ValueError: If there is NaN or inf, or the version is not 3 or 4.
        UsageError: If version 4 is asked for and ``zstandard`` is not installed.
    """
    if version not in VERSIONS:
        raise ValueError(f"spz_version: expected 3 or 4, got {version}")
    columns = spz_columns(gaussians, MAX_DEGREES[version], mip=mip)
    if version == 3:
        return gzip.compress(columns.header(3) + b"".join(columns.streams), mtime=0)  # the same bytes at any time
    compressor = zstandard().ZstdCompressor(level=ZSTD_LEVEL)
    packed = [compressor.compress(stream) for stream in columns.streams]
    sizes = [TABLE_ROW.pack(*map(len, pair)) for pair in zip(packed, columns.streams, strict=True)]
    start = TABLE_START.pack(HEADER.size + TABLE_START.size)
    return b"".join([columns.header(4), start, *sizes, *packed])


def zstandard() -> ModuleType:
    """The compression of version 4. UsageError if it is not installed."""
    try:
        import zstandard
    except ImportError as error:
        raise UsageError(f".spz of version 4: zstandard is not installed; {INSTALL}") from error
    return zstandard


def _fraction_bits(means: np.ndarray, fine: int) -> int:
    """Bits behind the point: as many as the scene's size asks for and its farthest Gaussian leaves."""
    if len(means) == 0:
        return 0
    size = np.median(np.abs(means - np.median(means, axis=0)).max(axis=1))
    wanted = fine - np.log2(max(size, 1e-6))
    left = np.log2(LARGEST / max(np.abs(means).max(), 1e-6))
    return int(np.clip(min(np.ceil(wanted), np.floor(left)), 0, MAX_FRACTION))


def _rotations(quats: np.ndarray) -> np.ndarray:
    """``[n,4]`` bytes: index of the largest of xyzw, then sign and magnitude of the others, the first one on top."""
    largest, others = smallest_three(np.roll(quats, -1, axis=1))
    parts = np.minimum(np.floor(511 * np.abs(others) * np.sqrt(2.0) + 0.5), 511).astype(np.uint32)
    parts |= (others < 0).astype(np.uint32) << np.uint32(9)
    words = largest.astype(np.uint32) << np.uint32(30)
    for i, shift in enumerate((20, 10, 0)):
        words |= parts[:, i] << np.uint32(shift)
    return words.astype("<u4")[:, None].view(np.uint8)


def _harmonics(harmonics: np.ndarray) -> np.ndarray:
    """``[n,3 (k-1)]`` bytes 128 + 128 x, rounded to steps of 8 for degree 1 and of 16 above."""
    steps = np.where(np.arange(harmonics.shape[1]) < 3, 8, 16)[:, None]
    values = np.round(np.clip(harmonics, -2, 2) * 128) + 128
    stepped = np.clip((values + steps // 2) // steps * steps, 0, 255).astype(np.uint8)
    return stepped.reshape(len(stepped), 3 * harmonics.shape[1])
