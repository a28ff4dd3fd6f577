"""Read and write PLY files with INRIA's columns; each header is checked against the size of its file."""

from __future__ import annotations

import re
import sys
import threading
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from io import BufferedReader, FileIO, TextIOWrapper
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, Literal

import numpy as np
from plyfile import PlyData, PlyElementParseError, PlyParseError

from gsmerge.errors import SceneError, UsageError
from gsmerge.io.bounds import ReadBudget, read_budget
from gsmerge.io.formats import arrays
from gsmerge.io.formats.columns import check_columns
from gsmerge.io.image_names import IMAGE_SUFFIXES, OTHER_SUFFIXES
from gsmerge.kernels.elementary import log, log1p
from gsmerge.runtime.plugins import LazyFunction
from gsmerge.runtime.threads import quiet_warnings
from gsmerge.types import Gaussians

_compressed_rows = LazyFunction("gsmerge.io.formats.compressed", "packed_rows")
_holds_cameras = LazyFunction("gsmerge.io.cameras.read", "holds_cameras")
MAX_DEGREE = 3  # of the harmonics in results; splat-transform 3.7 and gsply refuse a .ply with more
# Bytes of the longest comment on the expected scores of new views
COMMENT_BYTES = len(f"comment {arrays.new_views_comment(arrays.ExpectedScores(-100, -100, -100, -100))}\n")
MAX_READ_DEGREE = 4  # of harmonics in files of other programs
THIN = 1e-3  # third scale of a 2D Gaussian, relative to its smaller scale
MAX_LOGIT = 16.0  # from 16.6 on, the sigmoid rounds to 1 in float32, and the logit of 1 is infinite
BLOCK_BYTES = 1 << 19  # bytes of rows that are converted at a time; they stay in the processor's cache

_PREFIXED = "the prefix {!r} of the columns' names, as CloudCompare writes it, is ignored"
MAX_HEADER_BYTES = 1 << 20
MAX_LINE = 1 << 20  # most characters of a row of text, since its words take many times as much memory
_PLY_TYPES = {  # NumPy's names of types -> PLY's names
    "i1": "char", "i2": "short", "i4": "int", "f4": "float", "u1": "uchar", "u2": "ushort", "u4": "uint", "f8": "double"
}  # fmt: skip
_SIZES = {  # names of types -> bytes of a number
    **dict.fromkeys(("char", "uchar", "int8", "uint8", "i1", "u1", "b1"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16", "i2", "u2"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32", "i4", "u4", "f4"), 4),
    **dict.fromkeys(("double", "float64", "f8"), 8),
}


def read_rows(path: Path) -> arrays.StoredRows:
    """Open a PLY file for :func:`open_rows`, which reads its rows; raise SceneError if it holds no Gaussians."""
    data, num_left = open_ply(path)
    elements = {element.name: {column.name for column in element.properties} for element in data.elements}
    is_compressed = "chunk" in elements and elements.get("vertex", set()) >= set(arrays.PACKED)
    rows, prefix = (_compressed_rows(path, data), "") if is_compressed else _vertex_rows(path, data)
    extra_elements = tuple(name for name in elements if name != "vertex")
    layers = [f"element {name}" for name in extra_elements if {"opacity", arrays.QUATS[0]} <= elements[name]]
    unused = check_columns(path, rows.dtype, layers)
    names = tuple(rows.dtype.names or ())
    comments = (*data.comments, *(comment for element in data.elements for comment in element.comments))
    white, notes = _white_of_floats(path, rows)
    if arrays.SCALES[2] not in names:
        notes += [f"2D Gaussians have two scales; the third is set to {THIN:g} of the smaller one"]
        comments += (arrays.FLAT_COMMENT,)
    return arrays.StoredRows(
        rows=rows,
        layout=_layout_name(names, _num_rest(path, names), is_compressed=is_compressed),
        format="ascii" if data.text else "binary big-endian" if data.byte_order == ">" else "binary little-endian",
        encoding="logit" if is_compressed or is_from_gsmerge(comments) else None,
        sizes=_packed_bytes(rows) if is_compressed else _bytes_by_attribute(rows.dtype, len(rows)),
        comments=comments,
        extra_elements=extra_elements,
        notes=(
            *notes,
            *([_PREFIXED.format(prefix)] if prefix else []),
            *unused,
            *arrays.note_surplus(num_left, data["vertex"].data.dtype.itemsize),
        ),
        adapt=partial(_adapt_rows, white=white) if notes else None,
    )


def _white_of_floats(path: Path, rows: np.ndarray | arrays.PackedRows) -> tuple[float, list[str]]:
    """Return the number that stands for white in columns of RGB as floats, 1 or 255; also return notes on a guess."""
    colors = arrays.color_columns(rows.dtype.names)
    has_float_rgb = colors != arrays.SH0 and rows.dtype[colors[0]].kind == "f"
    if has_float_rgb and np.nanmedian(read_columns(path, rows, colors[:1])[colors[0]]) > 1:
        return 255.0, [f"colours are read as 0 to 255, since half of the values of {colors[0]} are above 1"]
    return 1.0, []


def read_columns(path: Path, rows: np.ndarray | arrays.PackedRows, names: Sequence[str]) -> np.ndarray:
    """Read some columns of a file's rows, block by block, as a structured array ``[n]`` of little-endian values."""
    out = np.empty(len(rows), [(name, rows.dtype[name].newbyteorder("<")) for name in names])
    block_rows = max(1, BLOCK_BYTES // rows.dtype.itemsize)
    with open_rows(path, rows) as read:
        for start in range(0, len(rows), block_rows):
            block = read(slice(start, start + block_rows))
            for name in names:
                out[name][start : start + block_rows] = block[name]
    return out


def _adapt_rows(rows: np.ndarray, *, white: float) -> np.ndarray:
    """Return a copy of a block of rows with three log scales, and with RGB colours in [0, 1].

    The third scale of 2D Gaussians is :data:`THIN` times the smaller scale. ``white``: the stored number for white.
    """
    columns = {name: rows[name] for name in rows.dtype.names or ()}
    if white != 1:
        columns |= {name: columns[name] / white for name in arrays.color_columns(rows.dtype.names)}
    scales = [columns[name].astype(np.float64) for name in arrays.SCALES if name in columns]
    with np.errstate(all="ignore"):  # scales may be NaN or infinite
        scales = scales if len(scales) == 3 else [*scales, np.minimum(*scales) + float(log(THIN))]
        columns |= {name: scale.astype(np.float32) for name, scale in zip(arrays.SCALES, scales, strict=True)}
    out = np.empty(len(rows), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        out[name] = column
    return out


def is_from_gsmerge(comments: Sequence[str]) -> bool:
    """Return whether header comments say that gsmerge wrote the file, be it a result or a copy."""
    return arrays.LOGIT_COMMENT in comments or arrays.RESULT_COMMENT in comments


def _vertex_rows(path: Path, data: PlyData) -> tuple[np.ndarray, str]:
    """Return the rows of the Gaussians with the usual names of columns, and the prefix that the names had.

    Raise SceneError if required columns are missing, or if there is no row.
    """
    if "vertex" not in data:
        names = ", ".join(f"'{e.name}'" for e in data.elements) or "none"
        raise SceneError(path, f"expected an element 'vertex', found {names}", "name a .ply of Gaussians")
    vertex = data["vertex"]
    rows, prefix = _without_prefix(vertex.data)
    columns = set(rows.dtype.names or ())
    # 2D Gaussians have no third scale, and files with plain colours have no harmonics of degree 0
    optional = {arrays.SCALES[2], *(() if arrays.color_columns(columns) == arrays.SH0 else arrays.SH0)}
    missing = [name for name in arrays.REQUIRED_COLUMNS if name not in columns | optional]
    if missing:
        check_columns(path, rows.dtype, ())  # raises a clearer error if other columns show the reason
        remedy = "name a .ply of Gaussians, since this one has none"
        if any(name.startswith("packed_") for name in columns):
            remedy = "export it again, since it is compressed but lacks its element 'chunk'"
        elif len(missing) < len(arrays.REQUIRED_COLUMNS) // 2:
            remedy = "export it again with them"
        if arrays.SCALES[0] in missing:  # without any scale, the third scale is expected, too
            missing = [name for name in arrays.REQUIRED_COLUMNS if name in {*missing, arrays.SCALES[2]} - columns]
        raise SceneError(path, f"missing column{'s' * (len(missing) > 1)} {', '.join(missing)}", remedy)
    if vertex.count == 0:
        raise SceneError(path, "expected at least one Gaussian, found 0 vertices", "export it again")
    return rows, prefix


def _without_prefix(rows: np.ndarray) -> tuple[np.ndarray, str]:
    """Return rows after removing a prefix from the names of their columns; also return the prefix, or "" if none.

    Columns ``rotation_0`` to ``rotation_3`` get their usual names. Nothing changes if names are usual or would not be
    unique, or if a column has lists. CloudCompare writes "scalar_" before column names that it does not know, and
    "scalar_scal_" if it writes a file with "scalar_" again.
    """
    names, known_name = tuple(rows.dtype.names or ()), arrays.QUATS[0]
    prefix = next((name.removesuffix(known_name) for name in names if name.endswith(known_name)), "")
    stripped = [re.sub(r"^rotation_(?=[0-3]$)", "rot_", name.removeprefix(prefix)) for name in names]
    if known_name in names or rows.dtype.hasobject or len(set(stripped)) < len(names):
        return rows, ""
    types = [rows.dtype[name] for name in names]
    fields: Any = rows.dtype.fields  # name -> type and offset in bytes
    offsets = [fields[name][1] for name in names]
    layout: Any = {"names": stripped, "formats": types, "offsets": offsets, "itemsize": rows.dtype.itemsize}
    return rows.view(np.dtype(layout)), prefix


def _num_rest(path: Path, columns: tuple[str, ...]) -> int:
    """Count the columns ``f_rest_*``; raise SceneError unless these are all harmonics up to a degree."""
    names = {name for name in columns if name.startswith("f_rest_")}
    if len(names) not in (0, 9, 24, 45, 72) or names != {f"f_rest_{i}" for i in range(len(names))}:
        numbers = "f_rest_0 to f_rest_8, _23, _44 or _71 (SH degree 1 to 4)"
        problem = f"expected columns {numbers} or none, found {len(names)} f_rest columns"
        raise SceneError(path, problem, "export it again")
    return len(names)


def _layout_name(names: tuple[str, ...], num_rest: int, *, is_compressed: bool) -> str:
    """Name the layout of a file's columns for the user."""
    if is_compressed:
        return f"compressed, SH degree {arrays.sh_degree(num_rest // 3)}"
    if arrays.SH0[0] not in names:
        return "columns of red, green and blue"
    normals = set(arrays.NORMALS) <= set(names)
    if num_rest == 0:
        return "17-column export" if normals else "14-column export (no normals)"
    return f"INRIA, SH degree {arrays.sh_degree(num_rest // 3)}" + ("" if normals else " (no normals)")


def _bytes_by_attribute(row_type: np.dtype[Any], count: int) -> dict[str, int]:
    """Return how many bytes each attribute, such as "means" or "scales", takes in ``count`` rows."""
    columns = {
        "means": arrays.MEANS,
        "normals": arrays.NORMALS,
        "sh0": arrays.color_columns(row_type.names),
        "opacities": ("opacity",),
        "scales": arrays.SCALES,
        "quats": arrays.QUATS,
    }
    attributes = {name: attribute for attribute, names in columns.items() for name in names}
    sizes: Counter[str] = Counter()
    for name in row_type.names or ():
        attribute = attributes.get(name, "shN" if name.startswith("f_rest_") else "extra")
        sizes[attribute] += row_type[name].itemsize * count
    return dict(sizes)


def _packed_bytes(rows: np.ndarray | arrays.PackedRows) -> dict[str, int]:
    """Return how many bytes each attribute takes in the rows of a compressed file.

    A row has four words of 4 bytes, one of them for colour and opacity, and a byte for each harmonic above degree 0.
    """
    num_rest = sum(name.startswith("f_rest_") for name in rows.dtype.names or ())
    each = {"means": 4, "quats": 4, "scales": 4, "sh0": 3, "opacities": 1, "shN": num_rest}
    return {name: size * len(rows) for name, size in each.items() if size}


def no_ply_error(path: Path) -> SceneError:
    """Return the error for a file that is no PLY file. If the file is a picture or has cameras, the error says so."""
    if path.suffix.lower() in IMAGE_SUFFIXES | OTHER_SUFFIXES:
        remedy = "make Gaussians from photos with a model first, and name its .ply"
        return SceneError(path, "expected Gaussians, found a picture", remedy)
    if _holds_cameras(path):
        return SceneError(path, "expected Gaussians, found cameras", "name the .ply, and this file with --cameras")
    problem = "expected a PLY file, found a file that does not start with the line 'ply'"
    return SceneError(path, problem, "name a .ply of Gaussians")


def open_ply(path: Path) -> tuple[PlyData, int]:
    """Open a PLY file; also return the number of bytes after its last element.

    Binary vertices that are not compressed stay in the file as a memory map, from which :func:`open_rows` reads later.
    All other content is read. Raise SceneError if the file is no PLY file, is damaged, or is shorter than its header
    says.
    """
    budget = read_budget(path)
    try:
        with path.open("rb") as file:
            start = file.read(MAX_HEADER_BYTES)
        if start[:4] not in (b"ply\n", b"ply\r"):
            raise no_ply_error(path)
        end, is_text = _check_header(start, budget)
        # plyfile warns of empty lists and of numbers that are too large for their type
        with _open_for_parser(path, end, is_text=is_text) as file, quiet_warnings():
            data = PlyData.read(file, mmap="r")
            num_left = len(file.read().strip()) if is_text else budget.file_bytes - file.tell()
        # On Windows no file stays mapped, since a mapped file cannot be replaced
        mapped = () if "chunk" in data or sys.platform == "win32" else ("vertex",)
        for element in data.elements:
            if isinstance(element.data, np.memmap) and element.name not in mapped:
                with open_rows(path, element.data) as read:
                    element.data = read(slice(None))
        return data, num_left
    except OSError as error:
        raise SceneError(path, f"cannot be read ({error.strerror})") from error
    except PlyElementParseError as error:
        element, row = error.element, error.row
        expected = f"element '{element.name}' with {element.count} rows" if element is not None else "more data"
        raise _truncated(path, expected, row or 0, error.message) from error
    except (PlyParseError, ValueError, ArithmeticError) as error:
        problem = f"expected a readable PLY file, found a damaged one ({error})"
        raise SceneError(path, problem, arrays.EXPORT_AGAIN) from error


def _open_for_parser(path: Path, end: int, *, is_text: bool) -> IO[Any]:
    """Open a PLY file for plyfile's parser, which refuses other bytes than ASCII in the header, and empty lines.

    ``end``: the size of the header in bytes. ``is_text``: whether the rows are text.
    """
    if is_text:
        return _TextRows(path.open("rb"), "ascii", "backslashreplace", newline="")
    file = _BinaryRows(FileIO(str(path)))
    file.end = end
    return file


class _TextRows(TextIOWrapper):
    """A PLY file of text whose empty lines are skipped."""

    def readline(self, size: int = -1, /) -> str:  # type: ignore[override]  # bytes in the base class
        line = super().readline(MAX_LINE)
        while line and not line.strip():
            line = super().readline(MAX_LINE)
        return line


class _BinaryRows(BufferedReader):
    """A binary PLY file in whose header each byte beyond ASCII becomes "?"."""

    end = 0  # of the header, in bytes

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if data.isascii() or self.tell() > self.end:
            return data
        return bytes(byte if byte < 128 else ord("?") for byte in data)


@contextmanager
def open_rows(path: Path, rows: np.ndarray | arrays.PackedRows) -> Iterator[Callable[[slice], np.ndarray]]:
    """Yield a thread-safe function that returns blocks of a PLY file's rows.

    Rows of a memory map are read from the file instead. If another program shortened the file, access to the map would
    end the process, while reading from the file raises SceneError.
    """
    if not isinstance(rows, np.memmap):
        yield rows.__getitem__
        return
    lock = threading.Lock()
    with path.open("rb") as file:

        def read(block: slice) -> np.ndarray:
            """Read a block of rows from the file."""
            start, stop, _ = block.indices(len(rows))
            out = np.empty(stop - start, rows.dtype)
            with lock:
                file.seek(rows.offset + start * rows.dtype.itemsize)
                num_bytes = file.readinto(out.view(np.uint8).data)
            if num_bytes < out.nbytes:
                num_whole = start + num_bytes // rows.dtype.itemsize
                raise _truncated(path, f"{len(rows)} rows", num_whole, "it became shorter while it was read")
            return out

        yield read


def header_counts(path: Path, *, check_size: bool = False) -> tuple[int, int]:
    """Return the numbers of Gaussians and of columns ``f_rest_*`` in a PLY file's header; zeros if it cannot be read.

    ``check_size``: also return zeros if the file is too short for the rows in its header.
    """
    header = _read_header(path, check_size=check_size)
    match = re.search(r"^element vertex (\d{1,12})\s*$", header, re.MULTILINE)
    num_rest = len(re.findall(r"^property \S+ \w*f_rest_\d+\s*$", header, re.MULTILINE))
    return int(match[1]) if match else 0, min(num_rest, 3 * ((MAX_READ_DEGREE + 1) ** 2 - 1))


def header_content(path: Path) -> Literal["result", "Gaussians", "other"]:
    """Guess from the header of a PLY file whether it is a result of gsmerge, has Gaussians, or has other columns.

    A file that cannot be read, or whose header is longer than 64 KiB, counts as Gaussians.
    """
    header = _read_header(path)
    if arrays.RESULT_COMMENT in _list_comments(header):
        return "result"
    columns = re.findall(r"^property .*?(\w+)\s*$", header, re.MULTILINE)
    stems = ("scale_", "rot_", "f_dc_", "packed_")  # names may have a prefix before these
    has_gaussians = any(stem in name for name in columns for stem in stems)
    return "Gaussians" if has_gaussians or not columns else "other"


def is_file_from_gsmerge(path: Path) -> bool:
    """Return whether the comments of a PLY file say that gsmerge wrote it."""
    return is_from_gsmerge(_list_comments(_read_header(path)))


def _read_header(path: Path, *, check_size: bool = False) -> str:
    """Return a PLY file's header; "" if the header is above 64 KiB or cannot be read.

    ``check_size``: also return "" if :func:`_check_header` refuses the file.
    """
    try:
        budget = read_budget(path)  # first, since reading a pipe would never end
        with path.open("rb") as file:
            start = file.read(1 << 16)
        if check_size:
            _check_header(start, budget)
    except (OSError, SceneError, ValueError):  # ValueError: a number of rows with too many digits
        return ""
    header, end, _ = start.decode("latin-1").partition("end_header")
    return header if end else ""


def _list_comments(header: str) -> list[str]:
    """List the comments of a header."""
    return re.findall(r"^comment (.*?)\s*$", header, re.MULTILINE)


def _check_header(start: bytes, budget: ReadBudget) -> tuple[int, bool]:
    """Return the size of a header in bytes, and whether rows are text; raise SceneError if the file is too short.

    ``start``: the first bytes of the file. The header may have other errors, which plyfile's parser finds later.
    """
    path, size = Path(budget.path), budget.file_bytes
    newline = b"\r\n" if start[3:5] == b"\r\n" else start[3:4]
    last_line = newline + b"end_header" + newline
    end = start.find(last_line)
    if end < 0:
        found = f"no 'end_header' within {MAX_HEADER_BYTES >> 20} MiB" if size > len(start) else "an early end of file"
        raise SceneError(path, f"expected a PLY header, found {found}", arrays.EXPORT_AGAIN)
    lines = [line.split() for line in start[:end].decode("latin-1").split(newline.decode())]
    is_text = ["format", "ascii", "1.0"] in lines
    elements = _parse_elements(lines)
    steps_per_element = 50  # steps of 20 microseconds for all readers that open the file one after another
    budget.check_steps(steps_per_element * len(elements), "steps for elements")
    bytes_left = size - end - len(last_line)
    for element in elements:
        _check_element(budget, element)
        # A number in text has at least a digit and a space. A list has at least its length, whose type is the second
        # word
        row_bytes = sum(2 if is_text else _SIZES.get((words[1:2] or words)[0], 1) for words in element.properties)
        bytes_before, bytes_left = bytes_left, bytes_left - element.count * row_bytes
        if bytes_left < -1:  # the last row of a text may end without a new line
            expected = f"element '{element.name}' with {element.count} rows"
            raise _truncated(path, expected, bytes_before // row_bytes, "early end of file")
    if is_text and "," in start[end + len(last_line) :].split(newline, 1)[0].decode("latin-1"):
        problem = "expected numbers with decimal points and spaces between them, found commas in the first row"
        raise SceneError(path, problem, "export it again with decimal points, or as binary")
    return end + len(last_line), is_text


@dataclass(frozen=True)
class _Element:
    """An element in the header of a PLY file."""

    name: str
    count: int  # number of rows
    # For each column, a list of words: [its type], or ["list", the type of the length, the type of the values]
    properties: list[list[str]] = field(default_factory=list)


def _parse_elements(lines: list[list[str]]) -> list[_Element]:
    """Return the elements of a header, whose ``lines`` are lists of words."""
    elements: list[_Element] = []
    for words in lines:
        if words[:1] == ["element"] and len(words) == 3 and re.fullmatch(r"[+-]?\d[\d_]*", words[2]):
            elements.append(_Element(words[1], int(words[2])))
        elif words[:1] == ["property"] and len(words) > 2 and elements:
            elements[-1].properties.append(words[1:-1])
    return elements


def _check_element(budget: ReadBudget, element: _Element) -> None:
    """Raise SceneError if an element has no columns, a negative count, vertices with lists, or too many lists."""
    path, name, count, num_columns = Path(budget.path), element.name, element.count, len(element.properties)
    has_lists = any(words[0] == "list" for words in element.properties)
    if count < 0:
        raise SceneError(
            path, f"expected a number of rows, found {count} rows of element '{name}'", arrays.EXPORT_AGAIN
        )
    if count and not num_columns:
        raise SceneError(
            path, f"expected columns, found element '{name}' of {count} rows without any", arrays.EXPORT_AGAIN
        )
    unknown = sorted({words[0] for words in element.properties if len(words) == 1} - _SIZES.keys())
    if unknown:
        problem = f"expected columns of float or another type of PLY, found {unknown[0]!r:.40} in element '{name}'"
        raise SceneError(path, problem, "export it again with columns of float")
    if has_lists and name == "vertex":
        raise SceneError(path, "expected one number per column and vertex, found a list property", arrays.EXPORT_AGAIN)
    max_lists = 1_000_000  # most lists of an element, since each value of a list is read by itself
    if has_lists and count * num_columns > max_lists:
        problem = f"expected at most {max_lists:,} lists, found element '{name}' with lists in {count:,} rows"
        raise SceneError(path, problem, "export it without this element")
    if has_lists:
        list_bytes = 140  # bytes of memory for each list
        budget.check_memory(list_bytes * count * num_columns, f"lists in {count:,} rows")


def _truncated(path: Path, expected: str, num_whole: int, reason: str) -> SceneError:
    """Make the SceneError for a file that ends, or is damaged, after ``num_whole`` complete rows."""
    return SceneError(
        path, f"truncated or damaged: expected {expected}, found {num_whole} complete ({reason})", arrays.EXPORT_AGAIN
    )


def ply_blocks(
    gaussians: Gaussians, degree: int, comments: Sequence[str], *, normals: bool, extra: np.ndarray | None = None
) -> Iterator[bytes | memoryview]:
    """Yield a PLY file's header and blocks of rows, with harmonics up to ``degree``; raise ValueError for NaN or inf.

    ``extra``: structured array ``[n]`` of little-endian columns, which are written after those of the Gaussians.
    """
    extra_types = {} if extra is None else {name: extra.dtype[name].str[1:] for name in extra.dtype.names or ()}
    header, num_columns = _header(len(gaussians), degree, comments, normals=normals, extra=extra_types)
    yield header
    for start, columns in arrays.column_blocks(gaussians, degree, max(1, BLOCK_BYTES // (4 * num_columns))):
        logits = log(columns.opacities) - log1p(-columns.opacities)  # infinite for 0 and 1, NaN outside [0, 1]
        parts = [
            columns.means,
            np.zeros((len(columns), 3 * normals)),
            columns.sh0,
            columns.harmonics.transpose(0, 2, 1).reshape(len(columns), 3 * columns.harmonics.shape[1]),
            np.clip(logits, -MAX_LOGIT, MAX_LOGIT)[:, None],
            columns.log_scales,
            columns.quats,
        ]
        rows = np.concatenate(parts, axis=1, dtype="<f4", casting="same_kind")
        if not np.isfinite(rows).all():
            raise ValueError(f"expected finite Gaussians, got an opacity outside [0, 1] in the rows from {start}")
        if not extra_types or extra is None:
            yield rows.data
            continue
        extra_bytes = np.ascontiguousarray(extra[start : start + len(rows)]).view(np.uint8).reshape(len(rows), -1)
        yield np.concatenate([rows.view(np.uint8), extra_bytes], axis=1).data


def _header(
    count: int,
    sh_degree: int,
    comments: Sequence[str] = (),
    *,
    normals: bool = True,
    extra: Mapping[str, str] = MappingProxyType({}),
) -> tuple[bytes, int]:
    """Return the header of a ``.ply`` of ``count`` Gaussians, and its number of float32 columns.

    ``extra``: name of each additional column -> NumPy's name of its type.
    """
    num_rest = 3 * ((sh_degree + 1) ** 2 - 1)
    names = [
        *arrays.MEANS,
        *(arrays.NORMALS if normals else ()),
        *arrays.SH0,
        *(f"f_rest_{i}" for i in range(num_rest)),
    ]
    names += ["opacity", *arrays.SCALES, *arrays.QUATS]
    # RESULT_COMMENT and LOGIT_COMMENT both state that opacities are logits, so that readers need not guess the encoding
    comments = comments if arrays.RESULT_COMMENT in comments else (arrays.LOGIT_COMMENT, *comments)
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [*(f"comment {comment}" for comment in comments), f"element vertex {count}"]
    lines += [f"property float {name}" for name in names]
    lines += [*(f"property {_PLY_TYPES[kind]} {name}" for name, kind in extra.items()), "end_header", ""]
    return "\n".join(lines).encode("ascii"), len(names)


def file_bytes(count: int, sh_degree: int) -> int:
    """Return the size in bytes of a ``.ply`` with ``count`` Gaussians, and with no comment but that of gsmerge."""
    header, num_columns = _header(count, min(sh_degree, MAX_DEGREE))
    return len(header) + 4 * num_columns * count


def count_for_bytes(max_bytes: int, sh_degree: int) -> int:
    """Return the largest number of Gaussians whose ``.ply`` has at most ``max_bytes``; raise UsageError if none fits.

    The size of the ``.ply`` includes the longest header comment on the expected scores of new views, even if the result
    has no such comment.
    """
    if not 0 <= sh_degree <= MAX_READ_DEGREE:
        raise ValueError(f"sh_degree: expected 0 to {MAX_READ_DEGREE}, got {sh_degree}")
    min_bytes = file_bytes(1, sh_degree) + COMMENT_BYTES
    if max_bytes < min_bytes:
        raise UsageError(f"budget: expected at least {min_bytes} bytes for one Gaussian, got {max_bytes}")
    return bisect_right(range(max_bytes), max_bytes - COMMENT_BYTES, key=lambda count: file_bytes(count, sh_degree)) - 1
