"""Read and write ``.spz``, a format of quantised columns (github.com/nianticlabs/spz, README and load-spz.cc).

Positions are fixed-point numbers of 24 bits. Log scales are steps of 1/16 from -10 on. Opacities and colours are bytes.
Rotations are the three smaller components of quaternions, each with a sign and 9 bits. Harmonics are bytes, which are
written in steps of ``HARMONIC_STEP``. Version 3 is one gzip stream, with harmonics up to degree 3. Version
4 has an uncompressed header, a table of compressed and uncompressed sizes, and one Zstandard stream for each column.

The README says that axes point right, up and back. However, Niantic's converters, splat-transform and SuperSplat write
the axes of a ``.ply``: right, down and front. This module writes the axes of a ``.ply``, too. The extension
``SPZ_ADOBE_coordinate_system`` may state other axes. The reader then rotates the Gaussians to the axes of a ``.ply``.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections import deque
from collections.abc import Iterable, Sequence
from functools import reduce
from itertools import chain, pairwise
from pathlib import Path
from typing import cast

import numpy as np

from gsmerge.arrays import as_array, to_float32
from gsmerge.errors import SceneError
from gsmerge.frozen import astuple, dataclass, replace
from gsmerge.io.bounds import ReadBudget, check_file, read_errors
from gsmerge.io.formats import rows as arrays
from gsmerge.io.formats.table import PLAIN, Contents
from gsmerge.method.geometry.transforms import rgb_to_sh0
from gsmerge.types import SH_C0, Gaussians, StrPath

# Default version and largest degree of harmonics of written files. Spark 2.2 does not read version 4 of the format, and
# old readers read only version 2
VERSION = 3
MAX_DEGREE = 3
MAGIC = 0x5053474E  # "NGSP", the first bytes of the header
HEADER = struct.Struct("<IIIBBBB")  # magic, version, count, SH degree, fraction bits, flags, number of streams or zero
TABLE_START = struct.Struct("<I12x")  # where the table of version 4 begins, in bytes from the file's start
TABLE_ROW = struct.Struct("<QQ")  # bytes of a stream: compressed, uncompressed
MIP_FLAG = 1  # flag of Gaussians that are rendered antialiased
EXTENSION_RECORD = struct.Struct("<II")  # kind of an extension, and its number of bytes
# Directions of the axes x, y and z, such as left, down and back. SPZ_ADOBE_coordinate_system states the number of an
# entry of this table, counted from 1
AXIS_SYSTEMS = (
    "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF",
    "LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU",
)  # fmt: skip
PLY_AXES = "RDF"
_REVERSED = {"LFD", "RFD", "LBU", "RBU"}  # axes whose y and z Niantic's library writes and reads with the wrong sign
_OPPOSITE = dict(zip("LRDUBF", "RLUDFB", strict=True))
_MAX_EXTENSIONS = 1 << 20  # most bytes of all extension records
GZIP_MAGIC, ZSTANDARD_MAGIC = b"\x1f\x8b", MAGIC.to_bytes(4, "little")  # first bytes of versions 1 to 3, and of 4
# position of the operating system in a gzip header, and the value that is always written
SYSTEM = 9
UNIX = b"\3"
SCENE_BITS = 14  # bits of a position within the scene: steps of a sixteenth of a pixel if the scene fills 1,000 pixels
LARGEST_POSITION = 2**23 - 1
_SHIFTS = (20, 10, 0)  # lowest bits of the three smaller components of a rotation in its word
# Step of harmonics, in 1/128. With steps of 2, the rounding of harmonics changes pictures as much as that of all other
# columns together: they are 52.1 dB from those of the scene, with steps of 1 55.0, with 4 47.9, and with Niantic's
# steps of 8 (degree 1) and 16 38.8. A file of as many bytes has a quarter fewer Gaussians than with Niantic's steps,
# and shows new views of a glossy room .3 to .5 dB better, whatever its size
HARMONIC_STEP = 2
COLOR_SCALE = 0.15  # factor of sh0, so that colours slightly outside [0, 1] can be stored
# Names of the attributes of Gaussians, in the order of a .spz file
ATTRIBUTES = ("means", "opacities", "sh0", "scales", "quats", "shN")
FOUND_EARLY_END = "expected a .spz file, found an early end of file"


@dataclass(frozen=True)
class Header:
    """The numbers in the header of a file, after its magic number."""

    version: int
    count: int  # of Gaussians
    degree: int  # of harmonics
    fraction: int  # bits of a position after the binary point
    flags: int
    num_streams: int  # number of compressed streams in version 4; 0 in older versions

    @property
    def num_higher(self) -> int:
        """Number of harmonics above degree 0."""
        return (self.degree + 1) ** 2 - 1

    @property
    def widths(self) -> tuple[int, ...]:
        """Bytes of each attribute of a Gaussian, in the order of ``ATTRIBUTES``."""
        return 6 if self.version == 1 else 9, 1, 3, 3, 4 if self.version > 2 else 3, 3 * self.num_higher


def read_rows(path: Path) -> arrays.StoredRows:
    """Read the Gaussians of a ``.spz``; raise SceneError if it is damaged."""
    check_file(path)
    with read_errors(path), path.open("rb") as file:
        packed = file.read(len(ZSTANDARD_MAGIC))
        if packed.startswith((GZIP_MAGIC, ZSTANDARD_MAGIC)):  # the rest of other files is not read
            file.seek(0)
            packed = file.read()
    header, rows, sizes, notes = read_packed(ReadBudget(path, len(packed)), packed)
    mode = arrays.MIP if header.flags & MIP_FLAG else None
    stored = arrays.to_stored([rows], f".spz version {header.version}", sizes, mode)
    return replace(stored, notes=notes)


def read_packed(
    budget: ReadBudget, packed: bytes, before: Sequence[arrays.Packed] = ()
) -> tuple[Header, arrays.Packed, dict[str, int], tuple[str, ...]]:
    """Read the content ``packed`` of a ``.spz``; return header, Gaussians, bytes by attribute, and notes.

    The Gaussians have the axes of a ``.ply``. ``budget``: the budget of the file that holds the content. ``before``:
    Gaussians from the same file that are in memory already, and that count in the budget, too.
    """
    path = budget.path
    read_parts = _zstandard_parts if packed.startswith(ZSTANDARD_MAGIC) else _gzip_parts
    header, parts, extensions, num_left = read_parts(budget, packed, before)
    sizes = {name: part.size for name, part in zip(ATTRIBUTES, parts, strict=True) if part.size}
    extensions_flag = 2  # flag of a file with extensions
    axes = _stored_axes(path, extensions) if header.flags & extensions_flag else PLY_AXES
    # The map from the file's axes to those of a .ply: a rotation, or a mirror image if the file's axes are left-handed
    rotation = np.array([[float(a == target) - float(_OPPOSITE[a] == target) for a in axes] for target in PLY_AXES])
    rotate = arrays.rotator(rotation * (1, -1, -1) if axes in _REVERSED else rotation, header.num_higher)
    rows = arrays.Packed(
        header.count, header.num_higher, lambda block: rotate(_unpack([part[block] for part in parts], header))
    )
    turned = f"Gaussians are turned from the file's axes {axes} to those of a .ply, {PLY_AXES}"
    notes = *([turned] if axes != PLY_AXES else []), *arrays.note_surplus(num_left, HEADER.size)
    return header, rows, sizes, notes


def _stored_axes(path: StrPath, extensions: bytes) -> str:
    """Return the axes of an extension, or else those of a ``.ply``; raise SceneError if the extension is damaged."""
    position = 0  # in ``extensions``
    # Kind of the extension SPZ_ADOBE_coordinate_system, whose content is 1 for the first of AXIS_SYSTEMS, and 0 for
    # unknown axes
    axes_kind = 0xADBE0003
    while position + EXTENSION_RECORD.size <= len(extensions):
        kind, size = EXTENSION_RECORD.unpack_from(extensions, position)
        position += EXTENSION_RECORD.size + size
        if kind == axes_kind:
            content = extensions[position - size : position]
            number = int.from_bytes(content, "little") if len(content) == size == 4 else -1
            if not 0 <= number <= len(AXIS_SYSTEMS):
                found = f"number {number}" if number > 0 else "a damaged record"
                problem = f"expected axes 0 to {len(AXIS_SYSTEMS)} in SPZ_ADOBE_coordinate_system, found {found}"
                raise SceneError(path, problem, "export it again without this extension")
            return AXIS_SYSTEMS[number - 1] if number else PLY_AXES
    return PLY_AXES


def _read_header(
    budget: ReadBudget, packed: bytes, start: bytes, versions: Sequence[int], before: Sequence[arrays.Packed]
) -> Header:
    """Parse the unpacked header, ``start``; raise SceneError if it is invalid or states too many Gaussians."""
    path = budget.path
    if len(start) < HEADER.size:
        raise SceneError(path, FOUND_EARLY_END, arrays.EXPORT_AGAIN)
    magic, *numbers = HEADER.unpack(start)
    header = Header(*numbers)
    max_read_degree = 4  # some programs write degree 4 in version 3
    if magic != MAGIC or header.version not in versions or header.degree > max_read_degree or header.fraction > 30:
        found = f"version {header.version}, SH degree {header.degree}" if magic == MAGIC else "another file"
        problem = f"expected .spz of version 1 to 4 and SH degree 0 to {max_read_degree}, found {found}"
        raise SceneError(path, problem, "export it again")
    if header.count == 0:
        raise SceneError(
            path, f"expected at least one Gaussian in {len(packed)} bytes, found a count of 0", arrays.EXPORT_AGAIN
        )
    # Parts of a .glb are stored alike, and those before this one are counted as if they were stored like this one
    num_higher = max([header.num_higher, *(part.num_higher for part in before)])
    count = header.count + sum(part.count for part in before)
    arrays.check_gaussian_count(budget, count, num_higher, sum(header.widths) + 3 * (num_higher - header.num_higher))
    return header


def _gzip_parts(
    budget: ReadBudget, packed: bytes, before: Sequence[arrays.Packed]
) -> tuple[Header, list[np.ndarray], bytes, int]:
    """Read version 1 to 3; return header, columns ``[n,width]`` uint8, extensions, and number of bytes at the end."""
    path = budget.path
    stream = zlib.decompressobj(wbits=31)
    try:
        header = _read_header(budget, packed, stream.decompress(packed, HEADER.size), (1, 2, 3), before)
        data = stream.decompress(stream.unconsumed_tail, header.count * sum(header.widths))
        # This call also compares the checksum. If the stream has ended, b"" is passed, since ``unused_data`` would
        # count other bytes twice
        extensions = stream.decompress(b"" if stream.eof else stream.unconsumed_tail, _MAX_EXTENSIONS)
    except zlib.error as error:
        raise SceneError(
            path, "expected a gzip stream of .spz, found another or damaged file", arrays.EXPORT_AGAIN
        ) from error
    ends = np.cumsum([0, *header.widths]) * header.count
    if len(data) < ends[-1] or not stream.eof:
        problem = f"truncated or damaged: expected {ends[-1]} bytes for {header.count} Gaussians, found {len(data)}"
        raise SceneError(path, f"{problem}{'' if stream.eof else ' and no end of the stream'}", arrays.EXPORT_AGAIN)
    parts = [np.frombuffer(data, np.uint8, end - at, at).reshape(header.count, -1) for at, end in pairwise(ends)]
    return header, parts, extensions, len(stream.unused_data)


def _zstandard_parts(
    budget: ReadBudget, packed: bytes, before: Sequence[arrays.Packed]
) -> tuple[Header, list[np.ndarray], bytes, int]:
    """Read version 4, with a stream per column; return the same as :func:`_gzip_parts`.

    Raise SceneError if the table contradicts the header, or if the file is too short for the table.
    """
    import zstandard  # few files need it

    path = budget.path
    header = _read_header(budget, packed, packed[: HEADER.size], (4,), before)
    sizes = [header.count * width for width in header.widths if width]
    try:
        (table_start,) = TABLE_START.unpack_from(packed, HEADER.size)
        table = [TABLE_ROW.unpack_from(packed, table_start + i * TABLE_ROW.size) for i in range(header.num_streams)]
    except struct.error as error:
        raise SceneError(path, FOUND_EARLY_END, arrays.EXPORT_AGAIN) from error
    if [unpacked_size for _, unpacked_size in table] != sizes:
        problem = f"damaged: expected columns of {sizes} bytes for {header.count} Gaussians, found others"
        raise SceneError(path, problem, arrays.EXPORT_AGAIN)
    # The start of each stream, followed by the end of the last one
    streams_start = table_start + len(table) * TABLE_ROW.size
    ends = streams_start + np.cumsum([0, *(packed_size for packed_size, _ in table)], dtype=object)
    if ends[-1] > len(packed):
        problem = f"truncated or damaged: expected {ends[-1]} bytes for {header.count} Gaussians, found {len(packed)}"
        raise SceneError(path, problem, arrays.EXPORT_AGAIN)
    streams = [packed[start:end] for start, end in pairwise(ends)]
    try:  # streams must be whole, and fit their checksums if they have any; a stream may not state its size
        if any(
            zstandard.frame_content_size(stream) not in (-1, size) for stream, size in zip(streams, sizes, strict=True)
        ):
            raise zstandard.ZstdError("streams of other sizes")
        columns = [
            zstandard.ZstdDecompressor().decompress(stream, size, allow_extra_data=False)
            for stream, size in zip(streams, sizes, strict=True)
        ]
        if [len(column) for column in columns] != sizes:
            raise zstandard.ZstdError("streams of other sizes")
    except zstandard.ZstdError as error:
        raise SceneError(
            path,
            "truncated or damaged: expected whole Zstandard streams with the sizes of its table, found others",
            arrays.EXPORT_AGAIN,
        ) from error
    columns += [b""] * (len(header.widths) - len(columns))  # degree 0 has no stream of harmonics
    parts = [np.frombuffer(column, np.uint8).reshape(header.count, -1) for column in columns]
    return header, parts, packed[HEADER.size + TABLE_START.size : table_start][:_MAX_EXTENSIONS], len(packed) - ends[-1]


def _unpack(parts: list[np.ndarray], header: Header) -> arrays.Columns:
    """Convert a block of rows, given as a part of each stored column, to Gaussians."""
    version = header.version
    fraction = header.fraction
    means, opacities, colors, scales, rotations, harmonics = parts
    # The three little-endian bytes of a signed number become the upper bytes of an int32, which is shifted and keeps
    # the sign
    words = np.zeros((len(means), 3, 4), np.uint8)
    if version > 1:
        words[..., 1:] = means.reshape(-1, 3, 3)
    if version < 3:
        xyz = rotations / 127.5 - 1
        w = np.sqrt(np.clip(1 - (xyz**2).sum(1, keepdims=True), 0, None))
        quats = np.concatenate([w, xyz], 1)
    else:
        rotation_words = rotations.view("<u4")[:, 0]  # the top two bits name the largest of xyzw
        largest = (rotation_words >> np.uint32(30)).astype(int)
        codes = np.stack([rotation_words >> np.uint32(shift) & np.uint32(1023) for shift in _SHIFTS], 1)
        smallest = np.where(codes & 512, -1.0, 1.0) * (codes & 511) / (511 * np.sqrt(2.0))
        quats = np.roll(arrays.from_smallest_three(largest, smallest), 1, axis=1)
    return arrays.Columns(
        means=means.view("<f2").astype(float) if version == 1 else (words.view("<i4")[..., 0] >> 8) / 2.0**fraction,
        quats=quats,
        log_scales=scales / 16 - 10,
        opacities=opacities[:, 0] / 255,
        sh0=rgb_to_sh0(0.5 + SH_C0 * (colors / 255 - 0.5) / COLOR_SCALE),
        harmonics=(harmonics.reshape(len(harmonics), -1, 3) - np.float32(128)) / np.float32(128),  # exact
    )


def _octave(size: float) -> int:
    """Return the exponent of the largest power of two that is not above a positive number."""
    return math.frexp(size)[1] - 1


def round_means(means: np.ndarray) -> np.ndarray:
    """Round means ``[n,3]`` as writing and reading a ``.spz`` does."""
    fraction = choose_fraction(means, SCENE_BITS)
    return to_float32(quantise_means(means, fraction) / 2.0**fraction)


def choose_fraction(means: np.ndarray, scene_bits: int) -> int:
    """Choose how many bits of quantised means follow the binary point.

    Means near the centre of the scene then need ``scene_bits`` bits, or fewer if the farthest mean would overflow
    otherwise.
    """
    if not len(means):
        return 0
    size = np.median(reduce(np.maximum, (np.abs(axis - np.median(axis)) for axis in means.T)))
    wanted_bits = scene_bits - _octave(max(size, 1e-6))
    bits_without_overflow = _octave(LARGEST_POSITION / max(np.abs(means).max(), 1e-6))
    max_fraction = 23  # bits; a position has 24, one of them for its sign
    return int(np.clip(min(wanted_bits, bits_without_overflow), 0, max_fraction))


def quantise_means(means: np.ndarray, fraction: int) -> np.ndarray:
    """Quantise means to fixed-point numbers int32 with ``fraction`` bits after the binary point."""
    return np.clip(np.round(means * 2.0**fraction), -LARGEST_POSITION, LARGEST_POSITION).astype("<i4")


def spz_columns(
    gaussians: Gaussians, max_degree: int, *, mip: bool = False, version: int = VERSION
) -> tuple[bytes, tuple[np.ndarray, ...]]:
    """Quantise Gaussians; return the header, and columns ``[n,bytes]`` uint8 in the order of the file.

    ``version``: 2 or 3. Raise ValueError if there is NaN or inf.
    """
    means = as_array(gaussians.means)
    count = len(gaussians)
    degree = min(max_degree, gaussians.sh_degree)
    # The fraction is chosen only if all means are finite, since other means raise an error later
    fraction = choose_fraction(means if np.isfinite(means).all() else means[:0], SCENE_BITS)
    header = Header(version, count=count, degree=degree, fraction=fraction, flags=MIP_FLAG * mip, num_streams=0)
    parts = tuple(np.empty((count, width), np.uint8) for width in header.widths)
    for start, columns in arrays.column_blocks(gaussians, max_degree):
        for part, values in zip(parts, _quantise(columns, header), strict=True):
            part[start : start + len(columns)] = values
    return HEADER.pack(MAGIC, *astuple(header)), parts


def _quantise(columns: arrays.Columns, header: Header) -> tuple[np.ndarray, ...]:
    """Quantise a block of Gaussians to columns of bytes.

    Version 2 stores the x, y and z of a rotation as bytes, with signs for which w is positive. Version 3 stores a word
    whose two highest bits are the index of the largest of xyzw. The sign and magnitude of each of the three other
    components follow.
    """
    fixed = quantise_means(columns.means, header.fraction)
    count, num_higher = columns.harmonics.shape[:2]
    if header.version < 3:
        rotations = arrays.to_bytes(127.5 * (np.where(columns.quats[:, :1] < 0, -1, 1) * columns.quats[:, 1:] + 1))
    else:
        largest, smallest = arrays.smallest_three(np.roll(columns.quats, -1, axis=1))
        codes = np.minimum(np.floor(511 * np.abs(smallest) * np.sqrt(2.0) + 0.5), 511).astype(np.uint32)
        codes |= (smallest < 0).astype(np.uint32) << np.uint32(9)
        words = largest.astype(np.uint32) << np.uint32(30)
        for i, shift in enumerate(_SHIFTS):
            words |= codes[:, i] << np.uint32(shift)
        rotations = words.astype("<u4")[:, None].view(np.uint8)
    stepped = np.round(np.clip(columns.harmonics, -2, 2) * (128 / HARMONIC_STEP)) * HARMONIC_STEP + 128
    return (
        fixed.view(np.uint8).reshape(-1, 3, 4)[..., :3].reshape(-1, 9),  # three little-endian bytes for each coordinate
        arrays.to_bytes(255 * columns.opacities)[:, None],
        arrays.to_bytes(255 * (COLOR_SCALE * (columns.colors - 0.5) / SH_C0 + 0.5)),
        arrays.to_bytes(16 * (columns.log_scales + 10)),
        rotations,
        np.clip(stepped, 0, 255).astype(np.uint8).reshape(count, 3 * num_higher),
    )


def spz_bytes(gaussians: Gaussians, contents: Contents = PLAIN) -> bytes:
    """Encode a ``.spz`` file in the version of ``contents.options``; raise ValueError if there is NaN or inf.

    Comments may state the mode of rendering, see :func:`gsmerge.io.formats.rows.render_mode`.

    The file has no extensions, since three 0.187 and mkkellogg's viewer refuse bytes after the columns.
    """
    mip = arrays.render_mode(contents.comments) == arrays.MIP
    version = contents.options.spz_version
    header, parts = spz_columns(gaussians, MAX_DEGREE, mip=mip, version=version)
    columns = deque(parts)
    del parts  # so that each column is freed as soon as it is compressed
    return gzip_bytes(chain([header], (columns.popleft().data for _ in range(len(columns)))))


def gzip_bytes(
    parts: Iterable[bytes | memoryview], *, level: int = 6, strategy: int = zlib.Z_DEFAULT_STRATEGY
) -> bytes:
    """Compress parts to a gzip stream, without the time and the system, so that equal parts give equal bytes."""
    # zlib writes no time
    packer = zlib.compressobj(level, wbits=31, strategy=strategy)
    packed = bytearray()
    for part in parts:
        packed += packer.compress(part)
    packed += packer.flush()
    packed[SYSTEM : SYSTEM + 1] = UNIX
    return cast(bytes, packed)  # a bytearray is written like bytes, and a copy would take memory
