"""Read and write PLY files with INRIA's columns; each header is checked against the size of its file.

Binary rows stay in the file, and are read block by block. Files of text, and files with lists, are read by plyfile.
"""

from __future__ import annotations

import os
import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from io import BufferedReader, FileIO, TextIOWrapper
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, Literal

import numpy as np
from plyfile import PlyData, PlyElementParseError, PlyParseError

from gsmerge.errors import SceneError, UsageError, count_words
from gsmerge.io.bounds import ReadBudget, read_budget, read_errors
from gsmerge.io.formats import rows as arrays
from gsmerge.io.formats import units
from gsmerge.io.formats.columns import check_columns
from gsmerge.io.formats.rows import FileRows, truncated
from gsmerge.io.image_names import IMAGE_SUFFIXES, OTHER_SUFFIXES
from gsmerge.method.kernels.elementary import log, log1p
from gsmerge.runtime.plugins import LazyFunction
from gsmerge.runtime.threads import quiet_warnings
from gsmerge.types import Gaussians

_compressed_rows = LazyFunction("gsmerge.io.formats.compressed", "packed_rows")
_holds_cameras = LazyFunction("gsmerge.io.cameras.read_cameras", "holds_cameras")
MAX_DEGREE = 3  # of the harmonics in results; splat-transform 3.7 and gsply refuse a .ply with more
# Bytes of the longest comment on the expected scores of new views
COMMENT_BYTES = len(f"comment {arrays.new_views_comment(arrays.ExpectedScores(-100, -100, -100, -100))}\n")
MAX_READ_DEGREE = 4  # of harmonics in files of other programs
THIN = 1e-3  # third scale of a 2D Gaussian, relative to its smaller scale

_PREFIXED = "the prefix {!r} of the columns' names, as CloudCompare writes it, is ignored"
MAX_HEADER_BYTES = 1 << 20
MAX_LINE = 1 << 20  # most characters of a row of text, since its words take many times as much memory
# NumPy's name of a type -> PLY's names of it; the first of them is written
_TYPE_NAMES = {
    "i1": ("char", "int8", "i1", "b1"), "i2": ("short", "int16", "i2"), "i4": ("int", "int32", "i4"),
    "u1": ("uchar", "uint8", "u1"), "u2": ("ushort", "uint16", "u2"), "u4": ("uint", "uint32", "u4"),
    "f4": ("float", "float32", "f4"), "f8": ("double", "float64", "f8"),
}  # fmt: skip
_TYPES = {name: np.dtype(code) for code, names in _TYPE_NAMES.items() for name in names}
_BYTE_ORDERS: dict[str, Literal["<", ">", "="]] = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class Element:
    """An element of a PLY file."""

    name: str
    count: int  # number of rows
    # Column -> words of its type: [the type], or ["list", the type of the length, the type of the values]
    columns: dict[str, list[str]] = field(default_factory=dict)
    rows: np.ndarray | FileRows = field(default_factory=lambda: np.empty(0))

    @property
    def has_lists(self) -> bool:
        """Return whether a column has lists."""
        return any(words[0] == "list" for words in self.columns.values())

    @property
    def row_type(self) -> np.dtype[np.void]:
        """Return the type of rows without lists."""
        return np.dtype([(name, _TYPES[words[0]]) for name, words in self.columns.items()])


@dataclass
class Header:
    """The header of a PLY file."""

    format: str  # of the rows: "ascii", "binary_little_endian" or "binary_big_endian"
    num_bytes: int = 0  # of the header
    elements: dict[str, Element] = field(default_factory=dict)
    comments: list[str] = field(default_factory=list)


def read_rows(path: Path) -> arrays.StoredRows:
    """Open a PLY file, whose rows are read later; raise SceneError if it holds no Gaussians."""
    header, num_left = open_ply(path)
    elements = header.elements
    is_compressed = {"chunk", "vertex"} <= elements.keys() and elements["vertex"].columns.keys() >= {*arrays.PACKED}
    rows, prefix = (_compressed_rows(path, elements), "") if is_compressed else _vertex_rows(path, elements)
    extra_elements = tuple(name for name in elements if name != "vertex")
    layers = [
        f"element {name}" for name in extra_elements if elements[name].columns.keys() >= {"opacity", arrays.QUATS[0]}
    ]
    unused = check_columns(path, rows.dtype, layers)
    if not is_compressed:
        _check_places(path, rows)
    names = tuple(rows.dtype.names or ())
    comments = tuple(header.comments)
    colors = arrays.color_columns(names)
    rest = {name for name in names if name.startswith("f_rest_")}
    white = 1.0
    notes = list[str]()
    if len(rest) not in (0, 9, 24, 45, 72) or rest != {f"f_rest_{i}" for i in range(len(rest))}:
        numbers = "f_rest_0 to f_rest_8, _23, _44 or _71 (SH degree 1 to 4)"
        problem = f"expected columns {numbers} or none, found {len(rest)} f_rest columns"
        raise SceneError(path, problem, "export it again")
    has_float_rgb = colors != arrays.SH0 and rows.dtype[colors[0]].kind == "f"
    if has_float_rgb and units.are_bytes(arrays.read_columns(rows, colors[:1])[colors[0]]):
        white = 255.0
        notes.append(f"colours are read as 0 to 255, since half of the values of {colors[0]} are above 1")
    if arrays.SCALES[2] not in names:
        notes.append(f"2D Gaussians have two scales; the third is set to {THIN:g} of the smaller one")
        comments += (arrays.FLAT_COMMENT,)
    layout = f"SH degree {arrays.sh_degree(len(rest) // 3)}"
    has_normals = set(arrays.NORMALS) <= set(names)
    if is_compressed:
        layout = f"compressed, {layout}"
    elif arrays.SH0[0] not in names:
        layout = "columns of red, green and blue"
    elif not rest:
        layout = "17-column export" if has_normals else "14-column export (no normals)"
    else:
        layout = f"INRIA, {layout}" + ("" if has_normals else " (no normals)")
    return arrays.StoredRows(
        rows=rows,
        layout=layout,
        format=header.format.replace("_", " ").replace(" endian", "-endian"),
        encoding="logit" if is_compressed or is_from_gsmerge(comments) else None,
        sizes=_bytes_by_attribute(rows.dtype, len(rows), is_compressed=is_compressed),
        comments=comments,
        extra_elements=extra_elements,
        notes=(
            *notes,
            *([_PREFIXED.format(prefix)] if prefix else []),
            *unused,
            *arrays.note_surplus(num_left, elements["vertex"].row_type.itemsize),
        ),
        adapt=partial(_adapt_rows, white=white) if notes else None,
    )


def _check_places(path: Path, rows: arrays.Rows) -> None:
    """Raise SceneError if the values of some rows stand beside the columns of their names.

    Unit quaternions show it: in a shifted file they have norm 1 in the wrong columns, in all rows that are looked at. A
    file whose quaternions are not normalised is not judged.
    """
    names = rows.dtype.names or ()
    sampled = rows[:1000]
    first = names.index(arrays.QUATS[0])
    types = {rows.dtype[name] for name in names}
    are_floats = len(types) == 1 and types.pop().kind == "f"
    if not are_floats or names[first : first + 4] != tuple(arrays.QUATS) or len(sampled) < 3:
        return
    with np.errstate(all="ignore"):  # values may be NaN or infinite
        values = np.stack([sampled[name].astype(np.float64) for name in names], 1)

    def are_unit(shift: int, axis: int | None) -> bool:
        """Return whether quaternions have norm 1 after all values move to the left, in their row or along all rows."""
        rounding = 1e-3  # of norms; half floats round them to this
        quats = np.roll(values, -shift, axis)[1:-1, first : first + 4]
        with np.errstate(all="ignore"):
            return bool((np.abs((quats * quats).sum(1) - 1) < 2 * rounding).all())

    if are_unit(0, 1):
        return
    for shift in (1, -1, 2, -2, 3, -3):
        if are_unit(shift, 1) or are_unit(shift, None):
            side = "after" if shift > 0 else "before"
            places = count_words(abs(shift), "place", f"{side} their columns")
            problem = (
                f"expected rotations in {arrays.QUATS[0]} to {arrays.QUATS[3]}, found all values of a row {places}"
            )
            raise SceneError(path, problem, "copy or export it again")


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


def _vertex_rows(path: Path, elements: Mapping[str, Element]) -> tuple[np.ndarray | FileRows, str]:
    """Return the rows of the Gaussians with the usual names of columns, and the prefix that the names had.

    Columns ``rotation_0`` to ``rotation_3`` get their usual names. Names do not change if they are usual or would not
    be unique. CloudCompare writes "scalar_" before column names that it does not know, and "scalar_scal_" if it writes
    a file with "scalar_" again. Raise SceneError if required columns are missing, or if there is no row.
    """
    if "vertex" not in elements:
        found = ", ".join(f"'{name}'" for name in elements) or "none"
        raise SceneError(path, f"expected an element 'vertex', found {found}", "name a .ply of Gaussians")
    rows = elements["vertex"].rows
    prefix = ""
    names = tuple(rows.dtype.names or ())
    known_name = arrays.QUATS[0]
    written = next((name.removesuffix(known_name) for name in names if name.endswith(known_name)), "")
    stripped = [re.sub(r"^rotation_(?=[0-3]$)", "rot_", name.removeprefix(written)) for name in names]
    if known_name not in names and len(set(stripped)) == len(names):
        types = [(new_name, rows.dtype[name]) for new_name, name in zip(stripped, names, strict=True)]
        rows = rows.view(np.dtype(types))
        prefix = written
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
    if len(rows) == 0:
        raise SceneError(path, "expected at least one Gaussian, found 0 vertices", "export it again")
    return rows, prefix


def _bytes_by_attribute(row_type: np.dtype[np.void], count: int, *, is_compressed: bool) -> dict[str, int]:
    """Return how many bytes each attribute, such as "means" or "scales", takes in ``count`` rows.

    A row of a compressed file has four words of 4 bytes, one of them for colour and opacity, and a byte for each
    harmonic above degree 0.
    """
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
    if is_compressed:
        each = {"means": 4, "quats": 4, "scales": 4, "sh0": 3, "opacities": 1, "shN": sizes["shN"] // (4 * count)}
        return {name: size * count for name, size in each.items() if size}
    return dict(sizes)


def no_ply_error(path: Path) -> SceneError:
    """Return the error for a file that is no PLY file. If the file is a picture or has cameras, the error says so."""
    if path.suffix.lower() in IMAGE_SUFFIXES | OTHER_SUFFIXES:
        remedy = "make Gaussians from photos with a model first, and name its .ply"
        return SceneError(path, "expected Gaussians, found a picture", remedy)
    if _holds_cameras(path):
        return SceneError(path, "expected Gaussians, found cameras", "name the .ply, and this file with --cameras")
    problem = "expected a PLY file, found a file that does not start with the line 'ply'"
    return SceneError(path, problem, "name a .ply of Gaussians")


def open_ply(path: Path) -> tuple[Header, int]:
    """Open a PLY file; return its header, whose elements have rows, and the number of bytes after the last element.

    Raise SceneError if the file is no PLY file, is damaged, or is shorter than its header says.
    """
    budget = read_budget(path)
    with read_errors(path), path.open("rb") as file:
        start = file.read(MAX_HEADER_BYTES)
        if start[:4] not in (b"ply\n", b"ply\r"):
            raise no_ply_error(path)
        header = _parse_header(budget, start)
        _check_sizes(budget, header, start)
        is_text = header.format == "ascii"
        if is_text or any(element.has_lists for element in header.elements.values()):
            return header, _read_by_plyfile(path, header, is_text=is_text)
        place = header.num_bytes
        inode = os.fstat(file.fileno()).st_ino
        for element in header.elements.values():
            row_type = element.row_type.newbyteorder(_BYTE_ORDERS[header.format])
            element.rows = FileRows(path, row_type, element.count, place, inode)
            place += element.count * row_type.itemsize
        return header, budget.file_bytes - place


def _read_by_plyfile(path: Path, header: Header, *, is_text: bool) -> int:
    """Read all rows of a file of text, or of one with lists; return the number of bytes after the last row."""
    file: IO[Any]
    if is_text:
        file = _TextRows(path.open("rb"), "ascii", "backslashreplace", newline="")
    else:
        file = _BinaryRows(FileIO(str(path)))
        file.num_header = header.num_bytes
    try:
        with file, quiet_warnings():  # plyfile warns of empty lists and of numbers that are too large for their type
            for element in PlyData.read(file, mmap=False).elements:
                header.elements[element.name].rows = element.data
            return len(file.read().strip() if is_text else file.read())
    except PlyElementParseError as error:
        name, count = (error.element.name, error.element.count) if error.element is not None else ("?", 0)
        raise truncated(path, f"element '{name}' with {count} rows", error.row or 0, error.message) from error
    except (PlyParseError, ValueError, ArithmeticError) as error:
        problem = f"expected a readable PLY file, found a damaged one ({error})"
        raise SceneError(path, problem, arrays.EXPORT_AGAIN) from error


class _TextRows(TextIOWrapper):
    """A PLY file of text for plyfile's parser, which refuses empty lines; they are skipped."""

    def readline(self, size: int = -1, /) -> str:  # type: ignore[override]  # bytes in the base class
        line = super().readline(MAX_LINE)
        while line and not line.strip():
            line = super().readline(MAX_LINE)
        return line


class _BinaryRows(BufferedReader):
    """A binary PLY file for plyfile's parser, which refuses headers with bytes beyond ASCII; each becomes "?"."""

    num_header = 0  # bytes of the header

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if data.isascii() or self.tell() > self.num_header:
            return data
        return bytes(byte if byte < 128 else ord("?") for byte in data)


def header_counts(path: Path, *, check_size: bool = False) -> tuple[int, int]:
    """Return the numbers of Gaussians and of columns ``f_rest_*`` in a PLY file's header; zeros if it cannot be read.

    ``check_size``: also return zeros if the file is too short for the rows in its header.
    """
    elements = read_header(path, check_size=check_size).elements
    names = [name for element in elements.values() for name in element.columns]
    num_rest = sum(re.fullmatch(r"\w*f_rest_\d+", name) is not None for name in names)
    count = elements["vertex"].count if "vertex" in elements else 0
    return max(0, count), min(num_rest, 3 * ((MAX_READ_DEGREE + 1) ** 2 - 1))


def header_content(path: Path) -> Literal["result", "Gaussians", "other"]:
    """Guess from the header of a PLY file whether it is a result of gsmerge, has Gaussians, or has other columns.

    A file that cannot be read, or whose header is longer than 64 KiB, counts as Gaussians.
    """
    header = read_header(path)
    if arrays.RESULT_COMMENT in header.comments:
        return "result"
    names = [name for element in header.elements.values() for name in element.columns]
    stems = ("scale_", "rot_", "f_dc_", "packed_")  # names may have a prefix before these
    has_gaussians = any(stem in name for name in names for stem in stems)
    return "Gaussians" if has_gaussians or not names else "other"


def read_header(path: Path, *, check_size: bool = False) -> Header:
    """Return a PLY file's header; an empty one if the header is damaged, is above 64 KiB or cannot be read.

    ``check_size``: also return an empty one if the file is too short for its rows.
    """
    try:
        budget = read_budget(path)  # first, since reading a pipe would never end
        with path.open("rb") as file:
            start = file.read(1 << 16)
        header = _parse_header(budget, start)
        if check_size:
            _check_sizes(budget, header, start)
    except (OSError, SceneError):
        return Header("")
    return header


def _parse_header(budget: ReadBudget, start: bytes) -> Header:
    """Parse the header of a PLY file from the ``start`` of the file; raise SceneError if it is damaged."""
    path = budget.path
    newline = b"\r\n" if start[3:5] == b"\r\n" else start[3:4]
    last_line = newline + b"end_header" + newline
    end = start.find(last_line)
    if end < 0:
        is_longer = budget.file_bytes > len(start)
        found = f"no 'end_header' within {MAX_HEADER_BYTES >> 20} MiB" if is_longer else "an early end of file"
        raise SceneError(path, f"expected a PLY header, found {found}", arrays.EXPORT_AGAIN)
    header = Header("", end + len(last_line))
    element = None
    text = start[:end].decode("ascii", "replace").replace("\N{REPLACEMENT CHARACTER}", "?")
    for number, line in enumerate(text.split(newline.decode()), 1):
        match line.split():
            case ["comment", *_]:
                header.comments.append(line.strip()[len("comment ") :])
            case ["format", name, "1.0"] if name in _BYTE_ORDERS and not header.format:
                header.format = name
            case ["element", name, count] if (
                header.format and name not in header.elements and re.fullmatch(r"[+-]?\d{1,4000}", count)
            ):
                element = header.elements[name] = Element(name, int(count))
            case ["property", *words, name] if element and len(words) in (1, 3) and name not in element.columns:
                element.columns[name] = words
            case [] | ["obj_info", *_]:
                pass
            case _ if number > 1:
                problem = f"expected a readable PLY file, found a damaged one (line {number}: {line.strip()!r:.60})"
                raise SceneError(path, problem, arrays.EXPORT_AGAIN)
    return header


def _check_sizes(budget: ReadBudget, header: Header, start: bytes) -> None:
    """Raise SceneError if a file is too short for the rows in its header, or if they are of a kind that is not read.

    An element is not read if it has no columns, a negative count, vertices with lists, or too many lists. ``start``:
    the first bytes of the file.
    """
    path = Path(budget.path)
    is_text = header.format == "ascii"
    steps_per_element = 50  # steps of 20 microseconds for all readers that open the file one after another
    budget.check_steps(steps_per_element * len(header.elements), "steps for elements")
    bytes_left = budget.file_bytes - header.num_bytes
    for element in header.elements.values():
        name = element.name
        count = element.count
        num_columns = len(element.columns)
        if count < 0:
            problem = f"expected a number of rows, found {count} rows of element '{name}'"
            raise SceneError(path, problem, arrays.EXPORT_AGAIN)
        if count and not num_columns:
            problem = f"expected columns, found element '{name}' of {count} rows without any"
            raise SceneError(path, problem, arrays.EXPORT_AGAIN)
        unknown = sorted({words[0] for words in element.columns.values() if len(words) == 1} - _TYPES.keys())
        if unknown:
            problem = f"expected columns of float or another type of PLY, found {unknown[0]!r:.40} in element '{name}'"
            raise SceneError(path, problem, "export it again with columns of float")
        if element.has_lists:
            if name == "vertex":
                problem = "expected one number per column and vertex, found a list property"
                raise SceneError(path, problem, arrays.EXPORT_AGAIN)
            max_lists = 1_000_000  # most lists of an element, since each list is passed over by itself
            if count * num_columns > max_lists:
                problem = f"expected at most {max_lists:,} lists, found element '{name}' with lists in {count:,} rows"
                raise SceneError(path, problem, "export it without this element")
            list_bytes = 140  # bytes of memory for each list
            budget.check_memory(list_bytes * count * num_columns, f"lists in {count:,} rows")
        # A number in text has at least a digit and a space. A list has at least its length, whose type is the second
        # word
        types = [(words[1:2] or words)[0] for words in element.columns.values()]
        row_bytes = sum(2 if is_text else _TYPES.get(word, _TYPES["char"]).itemsize for word in types)
        bytes_before = bytes_left
        bytes_left = bytes_left - count * row_bytes
        if bytes_left < -1:  # the last row of a text may end without a new line
            expected = f"element '{name}' with {count} rows"
            raise truncated(path, expected, bytes_before // row_bytes, "early end of file")
    if is_text and b"," in re.split(rb"[\r\n]", start[header.num_bytes :], maxsplit=1)[0]:
        problem = "expected numbers with decimal points and spaces between them, found commas in the first row"
        raise SceneError(path, problem, "export it again with decimal points, or as binary")


def ply_blocks(
    gaussians: Gaussians, degree: int, comments: Sequence[str], *, normals: bool, extra: np.ndarray | None = None
) -> Iterator[bytes | memoryview]:
    """Yield a PLY file's header and blocks of rows, with harmonics up to ``degree``; raise ValueError for NaN or inf.

    ``extra``: structured array ``[n]`` of little-endian columns, which are written after those of the Gaussians.
    """
    extra_types = {} if extra is None else {name: extra.dtype[name].str[1:] for name in extra.dtype.names or ()}
    header, num_columns = _header(len(gaussians), degree, comments, normals=normals, extra=extra_types)
    yield header
    for start, columns in arrays.column_blocks(gaussians, degree, max(1, arrays.BLOCK_BYTES // (4 * num_columns))):
        logits = log(columns.opacities) - log1p(-columns.opacities)  # infinite for 0 and 1, NaN outside [0, 1]
        parts = [
            columns.means,
            np.zeros((len(columns), 3 * normals)),
            columns.sh0,
            columns.harmonics.transpose(0, 2, 1).reshape(len(columns), 3 * columns.harmonics.shape[1]),
            np.clip(logits, -units.MAX_LOGIT, units.MAX_LOGIT)[:, None],
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
    lines += [*(f"property {_TYPE_NAMES[kind][0]} {name}" for name, kind in extra.items()), "end_header", ""]
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
