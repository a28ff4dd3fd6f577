"""Opening a PLY file: its header is weighed against the file's size before anything is allocated for it."""

from __future__ import annotations

import mmap
import re
import warnings
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElementParseError, PlyParseError

from gsmerge.errors import SceneError
from gsmerge.io.bounds import check_file

MAX_HEADER_BYTES = 1 << 20
MAX_LIST_VALUES = 1_000_000  # of elements with lists, which are read one value at a time
_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8", "i1", "u1", "b1"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16", "i2", "u2"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32", "i4", "u4", "f4"), 4),
    **dict.fromkeys(("double", "float64", "f8"), 8),
}


def open_ply(path: Path) -> PlyData:
    """A PLY file, mapped into memory where it is binary.

    Raises:
        SceneError: If it is none, is truncated or damaged, or promises more than it holds.
    """
    size = check_file(path)
    try:
        with path.open("rb") as file:
            start = file.read(MAX_HEADER_BYTES)
        if start[:3] != b"ply" or start[3:4] not in (b"\n", b"\r"):
            raise SceneError(
                path, "expected a PLY file, found one that does not start with the line 'ply'", "name the .ply"
            )
        _weigh(path, start, size)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an empty list, a number beyond the column's type
            return PlyData.read(str(path), mmap="r")
    except OSError as error:
        raise SceneError(path, f"cannot be read ({error.strerror})") from error
    except PlyElementParseError as error:
        element, row = error.element, error.row
        promise = f"element '{element.name}' with {element.count} rows" if element is not None else "more data"
        raise SceneError(
            path,
            f"truncated or damaged: expected {promise}, found {row or 0} whole ones ({error.message})",
            "copy or export it again",
        ) from error
    except (PlyParseError, ValueError, ArithmeticError, MemoryError) as error:
        raise SceneError(path, f"expected a readable PLY file, found a damaged one ({error})") from error


def let_go(rows: np.ndarray, block: slice) -> None:
    """Drop a block of rows of a mapped file from the process's memory; looked at again, it is read again."""
    mapped = getattr(rows, "_mmap", None)
    if not isinstance(rows, np.memmap) or mapped is None or not hasattr(mmap, "MADV_DONTNEED"):
        return
    before = rows.offset % mmap.ALLOCATIONGRANULARITY
    start, end = (before + row * rows.dtype.itemsize for row in (block.start, block.stop))
    start -= start % mmap.PAGESIZE
    mapped.madvise(mmap.MADV_DONTNEED, start, end - start)


def promised(path: Path) -> tuple[int, int]:
    """Gaussians that a PLY file promises, and their columns of higher harmonics, from its header alone.

    Zeros where there is none that can be read.
    """
    try:
        with path.open("rb") as file:
            header = file.read(1 << 16).partition(b"end_header")[0]
    except OSError:
        return 0, 0
    found = re.search(rb"^element vertex (\d{1,12})\s*$", header, re.MULTILINE)
    return int(found[1]) if found else 0, len(re.findall(rb"^property \S+ f_rest_\d+\s*$", header, re.MULTILINE))


def _weigh(path: Path, start: bytes, size: int) -> None:
    """Refuse a header that never ends, and elements with more rows than the rest of the file has bytes for.

    What else may be wrong with a header is left to the parser, which says it better.
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
        if line[:1] == ["element"] and len(line) == 3 and _is_int(line[2]):
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
            raise SceneError(
                path,
                f"truncated or damaged: expected element '{name}' with {count} rows, "
                f"found {before // each} whole ones (early end-of-file)",
                "copy or export it again",
            )


def _is_int(word: str) -> bool:
    try:
        int(word)
    except ValueError:
        return False
    return True
