"""Hold Gaussians in the units of most file formats, convert them from and to these units, and read header comments."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path

import numpy as np

from gsmerge.arrays import Array, as_array
from gsmerge.errors import Doubt, SceneError
from gsmerge.frozen import dataclass, fields, replace
from gsmerge.io.bounds import ReadBudget, read_errors
from gsmerge.method.geometry.transforms import (
    apply_harmonics_rotation,
    harmonics_rotation,
    morton_codes,
    multiply_quats,
    rotmat_to_quat,
    sh0_to_rgb,
)
from gsmerge.method.kernels.elementary import log
from gsmerge.method.kernels.matrices import matmul
from gsmerge.types import Gaussians

MAX_POSITION = 1e13  # no scene is larger, in any unit; squares and sums of such positions are finite in float32
BLOCK_ROWS = 1 << 16  # rows that are converted at a time
MAX_LOG_SCALE = 30.0  # exp(30) squared and exp(-30) squared are still normal float32 numbers
LOGIT_COMMENT = "opacity: logit"  # states the encoding in files of gsmerge, so that no reader guesses it
RESULT_COMMENT = "gsmerge result"  # replaces LOGIT_COMMENT in results of commands, and has the same length
RENDER_COMMENT = "SplatRenderMode"  # written by Brush, with the mode of rendering
NEW_VIEWS_COMMENT = "gsmerge new views"  # followed by the PSNR (dB) of new views of the input and of the result
# special modes of rendering: antialiased; 2D Gaussians
MIP = "mip"
FLAT = "2dgs"
MIP_COMMENT = f"{RENDER_COMMENT}: {MIP}"
FLAT_COMMENT = f"{RENDER_COMMENT}: {FLAT}"
_MODE = re.compile(rf"{RENDER_COMMENT}: (\w+)|antialiased ([01])")  # Brush's and Postshot's comments
_VERTICAL = re.compile(r"Vertical axis: [+-]?[xyz]", re.IGNORECASE)  # Brush's comment on the file's frame

MEANS = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")
PLAIN_COLORS = (("red", "green", "blue"), ("r", "g", "b"))  # instead of SH0, in files of nerfstudio and of 4DGT
SCALES = ("scale_0", "scale_1", "scale_2")
QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")  # of compressed PLYs
REQUIRED_COLUMNS = (*MEANS, *SH0, "opacity", *SCALES, *QUATS)
MAX_STRAY = 0.01  # share of a column's values that may contradict the others, because of rounding and damage
_EXACT = 1e-5  # largest rounding error of a whole number in a matrix that rotates harmonics
EXPORT_AGAIN = "copy or export it again"  # remedy for a damaged file
BLOCK_BYTES = 1 << 19  # bytes of rows that are converted at a time; they stay in the processor's cache
GAUSSIAN_BYTES = 4 * len(REQUIRED_COLUMNS) + 1  # bytes in memory of a Gaussian of degree 0 with its flag ``valid``


def sh_degree(num_higher: int) -> int:
    """Return the SH degree for ``num_higher`` coefficients above degree 0."""
    return round((num_higher + 1) ** 0.5) - 1


def copied_comments(comments: Sequence[object]) -> tuple[str, ...]:
    """Return the header comments that copies of a file keep: how to render the Gaussians, and which axis is vertical.

    If several comments state the mode of rendering or the axis, the last such comment counts.
    """
    mode = render_mode(comments)
    vertical = [line for line in comments if states_vertical_axis(line)]
    return (*([] if mode is None else [f"{RENDER_COMMENT}: {mode}"]), *map(str, vertical[-1:]))


def states_vertical_axis(comment: object) -> bool:
    """Return whether a header comment says which axis is vertical."""
    return isinstance(comment, str) and _VERTICAL.fullmatch(comment) is not None


def upward_axis(comments: Sequence[object]) -> str | None:
    """Return the axis that a header comment states as vertical, such as "z" or "-z"; None without such a comment.

    Also return None for "y", which programs write for the usual axis -y.
    """
    axes = [str(comment).split()[-1].lower().removeprefix("+") for comment in comments if states_vertical_axis(comment)]
    return axes[-1] if axes and axes[-1] != "y" else None


def render_mode(comments: Sequence[object]) -> str | None:
    """Return the mode of rendering that header comments ask for, ``MIP`` or ``FLAT``; None for the plain mode."""
    max_copied = 100  # most characters of a comment that is copied to other files
    lines = (line for line in comments if isinstance(line, str) and len(line) <= max_copied)
    matches = [match for match in map(_MODE.fullmatch, lines) if match is not None]
    if not matches:
        return None
    mode, antialiased = matches[-1].groups()
    mode = MIP if antialiased == "1" else (mode or "").lower()
    return mode if mode in (MIP, FLAT) else None


@dataclass(frozen=True)
class ExpectedScores:
    """PSNR (dB) that new views of a scene are expected to have.

    Args:
        before: Expected PSNR of new views rendered from the input.
        after: Expected PSNR of new views rendered from the result.
        low: Gain in PSNR that nine of ten results exceed.
        high: Gain in PSNR that one of ten results exceeds.
    """

    before: float
    after: float
    low: float
    high: float

    @property
    def gain(self) -> float:
        """Expected gain of PSNR (dB) of a new view."""
        return self.after - self.before


def describe_gain(low: float, high: float) -> str:
    """Describe the bounds of the expected gain of new views (dB), as every table and page does."""
    return f"{low:+.1f} to {high:+.1f} dB"


def result_comments(scores: ExpectedScores | None, kept: Sequence[str] = ()) -> list[str]:
    """Return the header comments of a result: its mark, comments ``kept`` from the input, and the expected scores."""
    return [RESULT_COMMENT, *kept, *([] if scores is None else [new_views_comment(scores)])]


def new_views_comment(scores: ExpectedScores) -> str:
    """Return the header comment of a result that states the expected scores of new views."""
    gain = f"gain {scores.low:.2f} to {scores.high:.2f} dB"
    return f"{NEW_VIEWS_COMMENT}: {scores.before:.2f} to {scores.after:.2f} dB, {gain}"


def read_expected_scores(comments: Sequence[object]) -> ExpectedScores | None:
    """Read the expected scores of new views from header comments; None without such a comment."""
    score = r"(-?\d{1,3}\.\d\d)"
    pattern = re.compile(f"{re.escape(NEW_VIEWS_COMMENT)}: {score} to {score} dB, gain {score} to {score} dB")
    matches = (pattern.fullmatch(comment) for comment in comments if isinstance(comment, str))
    match = next(filter(None, matches), None)
    return None if match is None else ExpectedScores(*map(float, match.groups()))


def note_surplus(num_bytes: int, min_bytes: int) -> tuple[Doubt, ...]:
    """Warn if at least ``min_bytes`` bytes follow the last row of a file; fewer bytes may be padding."""
    reason = "as if the header's count were too small or another file were appended"
    return (Doubt(f"{num_bytes:,} bytes follow the last row, {reason}"),) if num_bytes >= min_bytes else ()


def color_columns(names: Collection[str] | None) -> tuple[str, ...]:
    """Return the column names of the base colour: ``f_dc_*``, or plain colours if a file has no ``f_dc_*``."""
    plain = (colors for colors in PLAIN_COLORS if set(colors) <= set(names or ()))
    return SH0 if names is None or SH0[0] in names else next(plain, SH0)


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of n Gaussians in the units of most file formats.

    The fields are ``means [n,3]``, unit ``quats [n,4]`` wxyz, ``log_scales [n,3]``, ``opacities [n]`` in [0, 1],
    ``sh0 [n,3]`` and ``harmonics [n,k-1,3]``.
    """

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacities: np.ndarray
    sh0: np.ndarray
    harmonics: np.ndarray

    def __len__(self) -> int:
        return len(self.means)

    @property
    def colors(self) -> np.ndarray:
        """Base colours ``[n,3]`` as RGB, which may lie outside [0, 1]."""
        return sh0_to_rgb(self.sh0)

    def along_curve(self) -> Columns:
        """Return the rows in the order of a space-filling curve, in which neighbours in space stay close."""
        return self.take(np.argsort(morton_codes(self.means), kind="stable"))

    def take(self, rows: np.ndarray) -> Columns:
        """Return the rows with the given indices, in that order."""
        return Columns(*(column[rows] for column in vars(self).values()))


def concatenate(parts: Sequence[Columns], num_higher: int) -> Columns:
    """Concatenate rows with ``num_higher`` harmonics above degree 0; missing harmonics become zeros."""
    if len(parts) == 1 and parts[0].harmonics.shape[1] == num_higher:
        return parts[0]
    widened = [
        replace(part, harmonics=np.pad(part.harmonics, ((0, 0), (0, num_higher - part.harmonics.shape[1]), (0, 0))))
        for part in parts
    ]
    return Columns(*(np.concatenate([vars(part)[f.name] for part in widened]) for f in fields(Columns)))


@dataclass(frozen=True)
class Packed:
    """The ``count`` Gaussians of a file with packed columns; the thread-safe ``unpack`` returns a block of Gaussians.

    Gaussians are unpacked in blocks to save memory.
    """

    count: int
    num_higher: int  # harmonics above degree 0
    unpack: Callable[[slice], Columns]
    # Unpacks a block whose scales are stored as logarithms, against the format's rules; None if the format cannot
    unpack_logs: Callable[[slice], Columns] | None = None


@dataclass(frozen=True)
class PackedRows:
    """Packed Gaussians with the columns of a PLY file; ``rows[start:stop]`` unpacks the rows of the slice."""

    parts: Sequence[Packed]
    dtype: np.dtype[np.void]

    def __len__(self) -> int:
        return sum(part.count for part in self.parts)

    def __getitem__(self, block: slice) -> np.ndarray:
        start, stop, _ = block.indices(len(self))
        num_higher = _num_rest(self.dtype) // 3
        part_start = 0
        columns = []
        with np.errstate(all="ignore"):  # the reader accepts scales of 0, and sets aside rows that are not finite
            for part in self.parts:
                part_block = slice(max(start - part_start, 0), min(stop - part_start, part.count))
                is_empty = part_block.start >= part_block.stop  # the part has no row of the block
                columns += [] if is_empty else [part.unpack(part_block)]
                part_start += part.count
            joined = concatenate(columns, num_higher)
            harmonics = joined.harmonics.transpose(0, 2, 1).reshape(len(joined), 3 * num_higher)
            # Columns side by side, in the order of the names in :func:`pack_rows`
            parts = (joined.means, joined.sh0, harmonics, joined.opacities[:, None], joined.log_scales, joined.quats)
            table = np.concatenate(parts, axis=1, dtype=np.float32, casting="same_kind")
            return table.view(self.dtype)[:, 0]


def _num_rest(row_type: np.dtype[np.void]) -> int:
    """Count the columns ``f_rest_*``."""
    return sum(name.startswith("f_rest_") for name in row_type.names or ())


def truncated(path: Path, expected: str, num_whole: int, reason: str) -> SceneError:
    """Make the SceneError for a file that ends, or is damaged, after ``num_whole`` complete rows."""
    return SceneError(
        path, f"truncated or damaged: expected {expected}, found {num_whole} complete ({reason})", EXPORT_AGAIN
    )


@dataclass(frozen=True)
class FileRows:
    """Rows of numbers in a file; ``rows[start:stop]`` reads the rows of the slice, and is thread-safe."""

    path: Path
    dtype: np.dtype[np.void]
    count: int
    offset: int  # of the first row, in bytes from the start of the file
    inode: int  # of the file

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, block: slice) -> np.ndarray:
        start, stop, _ = block.indices(self.count)
        out = np.empty(stop - start, self.dtype)
        with read_errors(self.path), self.path.open("rb") as file:
            if os.fstat(file.fileno()).st_ino != self.inode:  # rows of two files must not mix
                raise SceneError(self.path, "was replaced while it was read", "run this again")
            file.seek(self.offset + start * self.dtype.itemsize)
            num_bytes = file.readinto(out.view(np.uint8).data)
        if num_bytes < out.nbytes:
            num_whole = start + num_bytes // self.dtype.itemsize
            raise truncated(self.path, f"{self.count} rows", num_whole, "it became shorter while it was read")
        return out

    def view(self, dtype: np.dtype[np.void]) -> FileRows:
        """Return the same rows with other names of columns."""
        return replace(self, dtype=dtype)


Rows = np.ndarray | FileRows | PackedRows  # a slice of them is an array of rows with one field per column


@dataclass(frozen=True, eq=False)
class StoredRows:
    """The Gaussians of a file before their units are converted, and facts about the file.

    After the function ``adapt``, ``rows`` have at least the columns ``REQUIRED_COLUMNS`` of a PLY file.
    """

    rows: Rows
    layout: str  # the name of the layout for people
    format: str
    encoding: str | None  # of the opacities: "logit", "raw", or None if the file does not say
    sizes: dict[str, int]  # bytes by attribute
    comments: tuple[str, ...] = ()
    extra_elements: tuple[str, ...] = ()
    bytes_beside: int = 0  # bytes of further files that hold the rows
    notes: tuple[str, ...] = ()  # how the content was adapted, one sentence each, without a full stop
    adapt: Callable[[np.ndarray], np.ndarray] | None = None  # converts a block of rows to the usual columns
    is_open: bool = False  # True: opacities and colours are floats, which may break the format's rules


def read_columns(rows: Rows, names: Sequence[str]) -> np.ndarray:
    """Read some columns of rows, block by block, as a structured array ``[n]`` of little-endian values."""
    out = np.empty(len(rows), [(name, rows.dtype[name].newbyteorder("<")) for name in names])
    block_rows = max(1, BLOCK_BYTES // rows.dtype.itemsize)
    for start in range(0, len(rows), block_rows):
        block = rows[start : start + block_rows]
        for name in names:
            out[name][start : start + block_rows] = block[name]
    return out


def pack_rows(parts: Sequence[Packed]) -> PackedRows:
    """Give packed Gaussians the columns of a PLY file; harmonics that a part lacks become zeros."""
    num_rest = 3 * max(part.num_higher for part in parts)
    names = (*MEANS, *SH0, *(f"f_rest_{i}" for i in range(num_rest)), "opacity", *SCALES, *QUATS)
    return PackedRows(parts, np.dtype([(name, np.float32) for name in names]))


def to_stored(parts: Sequence[Packed], format_name: str, sizes: dict[str, int], mode: str | None = None) -> StoredRows:
    """Give the packed Gaussians of a file the columns of a PLY file, and describe the file.

    ``sizes``: bytes by attribute. ``mode``: mode of rendering, see :func:`render_mode`.
    """
    rows = pack_rows(parts)
    return StoredRows(
        rows=rows,
        layout=f"{format_name}, SH degree {sh_degree(_num_rest(rows.dtype) // 3)}",
        format="quantised",
        encoding="raw",  # opacities in [0, 1]
        sizes=sizes,
        comments=() if mode is None else (f"{RENDER_COMMENT}: {mode}",),
    )


def max_array_bytes(file_bytes: int) -> int:
    """Return the size in bytes from which an array of Gaussians lies in a temporary file instead of memory.

    The harmonics that are unpacked from a file may be many times as large as the file.
    """
    return max(1 << 25, 8 * file_bytes)


def check_gaussian_count(budget: ReadBudget, count: int, num_higher: int, packed_bytes: int) -> None:
    """Raise SceneError if ``count`` Gaussians, with ``packed_bytes`` each, take more memory than ``budget`` allows."""
    # Harmonics above this number of bytes lie in a temporary file instead of memory
    harmonics_bytes = min(12 * num_higher * count, max_array_bytes(budget.file_bytes))
    unpacked_bytes = 16_000_000  # bytes of all blocks that are unpacked at the same time
    num_bytes = count * (packed_bytes + GAUSSIAN_BYTES) + harmonics_bytes + unpacked_bytes
    budget.check_memory(num_bytes, f"{count:,} Gaussians")


def to_columns(gaussians: Gaussians, max_degree: int, first_row: int = 0) -> Columns:
    """Convert Gaussians to columns with harmonics up to ``max_degree``; raise ValueError if a row is not finite.

    ``first_row``: number of the first Gaussian, for the error.
    """

    def check(values: np.ndarray) -> np.ndarray:
        """Return values unchanged; raise ValueError if any is not finite as float32."""
        with np.errstate(over="ignore"):
            nonfinite = np.argwhere(~np.isfinite(values.astype(np.float32)))  # no format holds larger numbers
        if len(nonfinite):
            raise ValueError(f"expected finite Gaussians, got NaN or inf in row {first_row + int(nonfinite[0, 0])}")
        return values

    def array(values: Array) -> np.ndarray:
        """Return values as float64; raise ValueError as in ``check``."""
        return check(as_array(values).astype(np.float64))

    degree = min(max_degree, gaussians.sh_degree)
    quats = array(gaussians.quats)
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    quats = np.where(length == 0, (1.0, 0.0, 0.0, 0.0), quats) / np.where(length == 0, 1, length)
    # The logarithm of a scale of 0 is set to the least allowed logarithm. Negative scales become NaN, which ``check``
    # refuses
    log_scales = np.clip(log(array(gaussians.scales)), -MAX_LOG_SCALE, MAX_LOG_SCALE)
    return Columns(
        means=array(gaussians.means),
        quats=quats,
        log_scales=check(log_scales),
        opacities=array(gaussians.opacities),
        sh0=array(gaussians.sh0)[:, 0],
        harmonics=array(gaussians.shN)[:, : (degree + 1) ** 2 - 1],
    )


def column_blocks(gaussians: Gaussians, max_degree: int, num_rows: int | None = None) -> Iterator[tuple[int, Columns]]:
    """Yield each block of Gaussians as :func:`to_columns` returns it, after the number of its first row.

    ``num_rows``: rows of a block; None: ``BLOCK_ROWS``. Blocks save memory, since columns take several times as much
    memory as Gaussians.
    """
    num_rows = num_rows or BLOCK_ROWS
    for start in range(0, len(gaussians), num_rows):
        yield start, to_columns(gaussians[start : start + num_rows], max_degree, start)


def rotator(rotation: np.ndarray, num_higher: int) -> Callable[[Columns], Columns]:
    """Return a function that rotates Gaussians by an orthogonal matrix ``[3,3]``, which may mirror them.

    ``num_higher``: number of harmonics of each Gaussian above degree 0.
    """
    if np.array_equal(rotation, np.eye(3)):
        return lambda columns: columns
    # A matrix that mirrors maps an ellipsoid to the same ellipsoid as the negative matrix, which is a rotation
    sign = np.sign((np.cross(rotation[0], rotation[1]) * rotation[2]).sum())  # of the determinant
    quat = rotmat_to_quat(sign * rotation[None])[0]
    matrix = harmonics_rotation(num_higher, rotation) if num_higher else np.zeros((0, 0))
    # Entries that are whole numbers up to rounding are rounded, so that the matrix of half a turn is exactly diagonal
    matrix = np.where(np.abs(matrix - np.round(matrix)) < _EXACT, np.round(matrix), matrix)
    is_diagonal, signs = np.array_equal(matrix, np.diag(np.diagonal(matrix))), np.diagonal(matrix)[:, None]

    def rotate(columns: Columns) -> Columns:
        """Rotate Gaussians."""
        harmonics = columns.harmonics
        return replace(
            columns,
            means=matmul(columns.means, rotation.T),
            quats=multiply_quats(quat, columns.quats),
            harmonics=harmonics * signs if is_diagonal else apply_harmonics_rotation(harmonics, matrix),
        )

    return rotate


def to_bytes(values: np.ndarray) -> np.ndarray:
    """Round to the nearest integer from 0 to 255, as uint8."""
    return np.clip(np.floor(values + 0.5), 0, 255).astype(np.uint8)


def from_smallest_three(largest: np.ndarray, smallest: np.ndarray) -> np.ndarray:
    """Invert :func:`smallest_three`: restore unit quaternions ``[n,4]``."""
    quats = np.empty((len(largest), 4))
    is_largest = np.arange(4) == largest[:, None]
    quats[~is_largest] = smallest.reshape(-1)
    quats[is_largest] = np.sqrt(np.clip(1 - (smallest**2).sum(1), 0, None))
    return quats


def smallest_three(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split unit quaternions ``[n,4]`` into the index ``[n]`` of the largest component and the other three ``[n,3]``.

    Signs are chosen so that the largest component is positive. Files leave the largest component out, since it follows
    from the other three components.
    """
    largest = np.abs(quats).argmax(1)
    rows = np.arange(len(quats))
    quats = quats * np.where(quats[rows, largest] < 0, -1.0, 1.0)[:, None]
    return largest, quats[np.arange(4) != largest[:, None]].reshape(-1, 3)
