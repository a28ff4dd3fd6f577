"""PLY files of Gaussians: their columns, and opening them with the header checked against the file's size.

Log scales, logits and channel-major harmonics exist only in what reads and writes files.
"""

from __future__ import annotations

import re
import threading
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BufferedReader, FileIO, TextIOWrapper
from pathlib import Path
from typing import IO, Any

import numpy as np
from plyfile import PlyData, PlyElementParseError, PlyListProperty, PlyParseError

from gsmerge.errors import SceneError
from gsmerge.io.bounds import check_file

MAX_LOG_SCALE = 30.0  # exp(30) squared and exp(-30) squared are still normal float32 numbers
MAX_HARMONIC = 1e6  # pictures of it can still be squared and summed in float32
MAX_LOGIT = 16.0  # from 16.6 on the sigmoid is 1 in float32, and its logit infinite
LOGIT_COMMENT = "opacity: logit"  # so that our own files are never guessed at
RENDER_COMMENT = "SplatRenderMode"  # brush writes it: plain, or mip for Gaussians with a filter of their own
MIP_COMMENT = f"{RENDER_COMMENT}: mip"

MEANS, NORMALS = ("x", "y", "z"), ("nx", "ny", "nz")
SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")
RGB = ("red", "green", "blue")  # instead of the former, in nerfstudio's files of plain colours
SCALES = ("scale_0", "scale_1", "scale_2")
QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
REQUIRED = (*MEANS, *SH0, "opacity", *SCALES, *QUATS)
BLOCK_BYTES = 1 << 19  # of file rows converted at a time: they stay in the cache from the first column to the last

MAX_HEADER_BYTES = 1 << 20
MAX_LIST_VALUES = 1_000_000  # of elements with lists, which are read one value at a time
_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8", "i1", "u1", "b1"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16", "i2", "u2"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32", "i4", "u4", "f4"), 4),
    **dict.fromkeys(("double", "float64", "f8"), 8),
}


def open_ply(path: Path) -> PlyData:
    """Open a PLY file; its binary vertices, unless packed, are mapped for :func:`open_rows`.

    SceneError if it is no PLY file, is truncated or damaged, or its header promises more than it has.
    """
    size = check_file(path)
    try:
        with path.open("rb") as file:
            start = file.read(MAX_HEADER_BYTES)
        if start[:4] not in (b"ply\n", b"ply\r"):
            problem = "expected a PLY file, found one that does not start with the line 'ply'"
            raise SceneError(path, problem, "name the .ply")
        end, text = _check_header(path, start, size)
        with _stream(path, end, text=text) as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an empty list, a number beyond the column's type
            data = PlyData.read(file, mmap="r")
        for element in data.elements:
            if isinstance(element.data, np.memmap) and (element.name != "vertex" or "chunk" in data):
                with open_rows(path, element.data) as read:  # small, or packed
                    element.data = read(slice(None))
        return data
    except OSError as error:
        raise SceneError(path, f"cannot be read ({error.strerror})") from error
    except PlyElementParseError as error:
        element, row = error.element, error.row
        promise = f"element '{element.name}' with {element.count} rows" if element is not None else "more data"
        raise _truncated(path, promise, row or 0, error.message) from error
    except (PlyParseError, ValueError, ArithmeticError) as error:
        raise SceneError(path, f"expected a readable PLY file, found a damaged one ({error})") from error


def _stream(path: Path, end: int, *, text: bool) -> IO[Any]:
    """Open a PLY file for the parser, without bytes beyond ASCII in the header and empty lines in the text."""
    if text:
        return _TextRows(path.open("rb"), "ascii", "backslashreplace", newline="")
    file = _BinaryRows(FileIO(str(path)))
    file.end = end
    return file


class _TextRows(TextIOWrapper):
    def readline(self, size: int = -1, /) -> str:  # type: ignore[override]  # bytes in the base of all
        line = super().readline(size)
        while line and not line.strip():
            line = super().readline(size)
        return line


class _BinaryRows(BufferedReader):
    end = 0  # of the header

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if data.isascii() or self.tell() > self.end:
            return data
        return bytes(byte if byte < 128 else ord("?") for byte in data)


@contextmanager
def open_rows(path: Path, rows: np.ndarray) -> Iterator[Callable[[slice], np.ndarray]]:
    """Yield a function that returns blocks of a PLY file's rows; several threads may call it.

    Mapped pages of a file that shrinks would end the process; reading such a file is a SceneError.
    """
    if not isinstance(rows, np.memmap):
        yield rows.__getitem__
        return
    lock = threading.Lock()
    with path.open("rb") as file:

        def read(block: slice) -> np.ndarray:
            start, stop, _ = block.indices(len(rows))
            out = np.empty(stop - start, rows.dtype)
            with lock:
                file.seek(rows.offset + start * rows.dtype.itemsize)
                num_bytes = file.readinto(out.view(np.uint8).data)
            if num_bytes < out.nbytes:
                whole = start + num_bytes // rows.dtype.itemsize
                raise _truncated(path, f"{len(rows)} rows", whole, "it became shorter while it was read")
            return out

        yield read


def bytes_after_rows(path: Path) -> int:
    """Count the bytes of a binary PLY file after its last row; 0 where rows are text or have lists."""
    data = open_ply(path)
    if data.text or any(isinstance(p, PlyListProperty) for element in data.elements for p in element.properties):
        return 0
    with path.open("rb") as file:
        end, _ = _check_header(path, file.read(MAX_HEADER_BYTES), size := check_file(path))
    return size - end - sum(element.data.nbytes for element in data.elements)


def header_counts(path: Path) -> tuple[int, int]:
    """Return the numbers of Gaussians and of ``f_rest`` columns in a PLY file's header; zeros if unreadable."""
    try:
        check_file(path)  # a pipe would never end
        with path.open("rb") as file:
            header = file.read(1 << 16).partition(b"end_header")[0]
    except (OSError, SceneError):
        return 0, 0
    match = re.search(rb"^element vertex (\d{1,12})\s*$", header, re.MULTILINE)
    return int(match[1]) if match else 0, len(re.findall(rb"^property \S+ f_rest_\d+\s*$", header, re.MULTILINE))


def _check_header(path: Path, start: bytes, size: int) -> tuple[int, bool]:
    """Return the size of a header and whether rows are text; SceneError if the file is too short for it.

    ``start`` has the first bytes of ``size``. Everything else is left to the parser.
    """
    newline = b"\r\n" if start[3:5] == b"\r\n" else start[3:4]
    last = newline + b"end_header" + newline
    end = start.find(last)
    if end < 0:
        problem = f"no 'end_header' within {MAX_HEADER_BYTES >> 20} MiB" if size > len(start) else "early end of file"
        raise SceneError(path, f"expected a PLY header, found {problem}", "copy or export it again")
    words = [line.split() for line in start[:end].decode("latin-1").split(newline.decode())]
    text = ["format", "ascii", "1.0"] in words
    elements: list[tuple[str, int, list[list[str]]]] = []
    for line in words:
        if line[:1] == ["element"] and len(line) == 3 and re.fullmatch(r"[+-]?\d[\d_]*", line[2]):
            elements.append((line[1], int(line[2]), []))
        elif line[:1] == ["property"] and len(line) > 2 and elements:
            elements[-1][2].append(line[1:-1])
    left = size - end - len(last)
    for name, count, properties in elements:
        lists = any(kind[0] == "list" for kind in properties)
        if count < 0:
            raise SceneError(path, f"expected a number of rows, found element '{name}' with {count}")
        if count and not properties:
            raise SceneError(path, f"expected columns, found element '{name}' of {count} rows without any")
        if lists and name == "vertex":
            raise SceneError(path, "expected one number a column and vertex, found a list property")
        if lists and count * len(properties) > MAX_LIST_VALUES:
            raise SceneError(path, f"found element '{name}' with lists in {count} rows", "export it without this one")
        each = sum(2 if text else _SIZES.get((kind[1:2] or kind)[0], 1) for kind in properties)
        before, left = left, left - count * each
        if left < -1:  # the last row of a text may end without a new line
            raise _truncated(path, f"element '{name}' with {count} rows", before // each, "early end-of-file")
    return end + len(last), text


def _truncated(path: Path, promise: str, num_whole: int, reason: str) -> SceneError:
    problem = f"truncated or damaged: expected {promise}, found {num_whole} whole ones ({reason})"
    return SceneError(path, problem, "copy or export it again")


def sh_degree(num_rest: int) -> int:
    """Return the SH degree of a number of ``f_rest`` columns."""
    return round((num_rest / 3 + 1) ** 0.5) - 1


def color_columns(names: tuple[str, ...] | None) -> tuple[str, ...]:
    """Name the columns of the base colour."""
    return SH0 if names is None or SH0[0] in names else RGB


def spread_low_degree(shN: np.ndarray) -> None:
    """Move harmonics of a low degree to their places in ``shN [n,15,3]``, in place.

    Long-LRM writes 45 columns whatever the degree, the used ones channel-major in the first 9 or 24.
    """
    if shN.shape[1] != 15:
        return
    columns = shN.transpose(0, 2, 1).reshape(len(shN), 45)
    last = int(np.flatnonzero(columns.any(0)).max(initial=-1))
    for higher in (3, 8):
        if 0 <= last < 3 * higher:
            shN[:] = 0
            shN[:, :higher] = columns[:, : 3 * higher].reshape(-1, 3, higher).transpose(0, 2, 1)
            return


def layout_name(names: tuple[str, ...], num_rest: int, *, compressed: bool) -> str:
    """Name the layout of a file with these columns."""
    if compressed:
        return f"compressed, SH degree {sh_degree(num_rest)}"
    if SH0[0] not in names:
        return "columns of red, green and blue"
    normals = set(NORMALS) <= set(names)
    if num_rest == 0:
        return "17-column export" if normals else "14-column export (no normals)"
    return f"INRIA, SH degree {sh_degree(num_rest)}" + ("" if normals else " (no normals)")


def bytes_by_attribute(row: np.dtype[Any], count: int, extra: tuple[str, ...]) -> dict[str, int]:
    """Count the bytes of ``count`` rows by attribute; ``extra`` columns are ignored by readers."""
    groups = {"means": MEANS, "normals": NORMALS, "sh0": color_columns(row.names), "opacities": ("opacity",)}
    groups |= {"scales": SCALES, "quats": QUATS, "extra": extra}
    kinds = {name: kind for kind, names in groups.items() for name in names}
    sizes: Counter[str] = Counter()
    for name in row.names or ():
        sizes[kinds.get(name, "shN")] += row[name].itemsize * count
    return dict(sizes)
