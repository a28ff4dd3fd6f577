"""Read Gaussians from files: convert stored columns, such as log scales and logits, to the units of the package."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import Doubt, Note, SceneError, count_words
from gsmerge.frozen import dataclass
from gsmerge.io.formats import ply
from gsmerge.io.formats import rows as arrays
from gsmerge.io.formats.rows import MIP, StoredRows, render_mode
from gsmerge.io.formats.table import META, PLY, READ_ENDINGS, find_format
from gsmerge.io.formats.units import ColorUnits, choose_colors, choose_opacities, choose_scales
from gsmerge.method.geometry.transforms import lower_median, rgb_to_sh0
from gsmerge.method.kernels.elementary import exp
from gsmerge.method.kernels.stored_rows import convert_rows
from gsmerge.runtime.arguments import check_arguments
from gsmerge.runtime.memory import free_pages, make_array
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.reading import ColorChoice, FileHints, OpacityChoice, ScaleChoice
from gsmerge.types import Gaussians, StrPath

MAX_HARMONIC = 1e6  # no scene has larger harmonics; squares and sums of such renders are finite in float32
FREED_ROWS = 1 << 17  # number of converted rows after which the memory of large columns is freed


@dataclass(frozen=True)
class FileInfo:
    """Facts about a file of Gaussians, whose columns are named as in a PLY file, whatever the format is."""

    path: str
    layout: str  # name of the column layout, such as "17-column export" or "INRIA, SH degree 3"
    format: str  # "ascii", "binary little-endian" or "binary big-endian"
    count: int  # number of rows, including unusable ones
    file_bytes: int  # bytes of the file; of levels of detail, also of the chunks of the level that is read
    # Attribute (means, normals, sh0, shN, opacities, scales, quats, extra) -> its bytes. Of an ascii file, the bytes in
    # binary; of a .spz, before compression; of a .sog, with opacities in sh0
    bytes_by_attribute: dict[str, int]
    columns: tuple[str, ...]  # all columns of the vertex element, in the file's order
    extra_columns: tuple[str, ...]  # the columns that do not belong to Gaussians
    extra_elements: tuple[str, ...]  # elements besides ``vertex``
    byte_columns: tuple[str, ...]  # columns that are stored as bytes
    comments: tuple[str, ...]  # of the header
    sh_degree: int  # 0 to 4
    opacity_encoding: str  # "logit", or "raw" if the file holds opacities in [0, 1]
    opacity_guessed: bool  # True: the encoding was guessed from the values; False: the caller or the file states it
    num_nonfinite: int  # rows with NaN, inf, a log scale above 30 or a harmonic beyond +-1e6, which are set aside
    num_empty: int  # rows that only pad the file, which are set aside
    num_zero_quats: int  # Gaussians with a zero quaternion, read as the identity
    # One sentence without a full stop that says why the scales are likely wrong; empty if the scales are plausible
    odd_scales: str = ""
    opacity_note: str = ""  # sentence without a full stop on a guess of ``opacity_encoding``
    color_units: ColorUnits | None = None  # units of RGB in the columns of harmonics; None if these hold harmonics
    color_note: str = ""  # sentence without a full stop that says that ``color_units`` were guessed
    open_units: ColorUnits | None = None  # units of RGB that the columns may have if photos confirm it; None: none
    adapted: tuple[str, ...] = ()  # how the content was adapted, one sentence each without a full stop

    @property
    def antialiased(self) -> bool:
        """Whether the file says that its Gaussians are drawn antialiased, see :func:`gsmerge.render`."""
        return render_mode(self.comments) == MIP


@dataclass(frozen=True, eq=False)
class GaussianFile:
    """The n Gaussians of a file, row by row, as float32; means are float64 if the file stores them as float64.

    ``valid [n]`` is False for rows that are not finite or only pad the file. A row that is not valid is fully
    transparent and grey, and has the position and scales of the Gaussian before it.
    """

    gaussians: Gaussians
    valid: np.ndarray
    info: FileInfo

    def __repr__(self) -> str:
        return f"GaussianFile({self.gaussians!r} of {self.info.path})"


def kept_comments(info: FileInfo) -> tuple[str, ...]:
    """Return the header comments that copies of a file keep: how to render Gaussians, and which axis is vertical."""
    return arrays.copied_comments(info.comments)


def file_notes(info: FileInfo) -> tuple[str, ...]:
    """Describe adapted or unusual content of a file for the user: one sentence each, without a full stop."""
    counts = (
        (info.num_nonfinite, "row", "with NaN, inf or numbers that no scene has, set aside"),
        (info.num_empty, "empty row", "at the origin, set aside"),
        (info.num_zero_quats, "Gaussian", "with a zero quaternion, read as the identity"),
    )
    color_notes = (Note(info.color_note, "colors"),) if info.color_note else ()
    opacity_notes = (info.opacity_note,) if info.opacity_note else ()
    scale_notes = (Doubt(info.odd_scales),) if info.odd_scales else ()
    count_notes = (count_words(count, noun, rest) for count, noun, rest in counts if count)
    return (*info.adapted, *color_notes, *opacity_notes, *scale_notes, *count_notes)


def degree_notes(info: FileInfo) -> tuple[str, ...]:
    """Note, as :func:`file_notes` does, if a ``.ply`` has harmonics of a degree that other programs refuse."""
    if info.sh_degree <= ply.MAX_DEGREE or not PLY.names(info.path):
        return ()
    return (f"splat-transform 3.7 and gsply refuse a .ply with harmonics of degree {info.sh_degree}, as this one has",)


@check_arguments
def read_ply(
    path: StrPath, *, opacity: OpacityChoice = "auto", scales: ScaleChoice = "auto", colors: ColorChoice = "auto"
) -> GaussianFile:
    """Read a PLY file of Gaussians, binary or ascii, with harmonics of any degree up to 4.

    Additional columns are not used. Without harmonics of degree 0, colours may be red, green and blue, or r, g and b
    (bytes, or floats in [0, 1]). 2D Gaussians have two scales, and get as third scale a thousandth of the smaller one.

    Args:
        path: The file.
        opacity: How opacities are stored. "auto" reads them as opacities if the finite values lie in [0, 1], else
            as logits. Infinite logits are opacities of 0 and 1.
        scales: How scales are stored. "auto" reads them as logarithms, unless the size of the scene shows that
            they are linear.
        colors: What ``f_dc_*`` hold: harmonics, RGB, or logits of RGB. "auto" reads them as harmonics, unless they fill
            the range of RGB and hardly any value lies outside of it, or columns red, green and blue show otherwise.

    Raises:
        SceneError: If the file cannot be read, lacks columns, or has fewer than 2 finite Gaussians in 1,000 rows.
        ValueError: If ``opacity`` is not "auto", "logit" or "raw", ``scales`` not "auto", "log" or "linear", or
            ``colors`` not "auto", "sh", "rgb" or "logit".

    Example:
        >>> len(gsmerge.read_ply("demo/scene.ply").gaussians)
        7680
    """
    return read_parts([Path(path)], opacity=opacity, scales=scales, colors=colors)


def read_parts(
    paths: Sequence[Path],
    *,
    opacity: OpacityChoice = "auto",
    scales: ScaleChoice = "auto",
    colors: ColorChoice = "auto",
) -> GaussianFile:
    """Read one or several PLY files as one file, in the given order.

    Errors are those of :func:`read_ply`; also raise SceneError if the columns of the files differ.
    """
    hints = FileHints(opacity=opacity, scales=scales, colors=colors)
    parts = parallel_map(ply.read_rows, paths)
    for path, part in zip(paths, parts, strict=True):
        if part.rows.dtype != parts[0].rows.dtype:
            problem = f"expected the same columns as in {paths[0].name}, found others, so these are no parts of a scene"
            raise SceneError(path, problem, "name one of the files")
    return convert_stored(paths, parts, hints)


@check_arguments
def read_gaussians(
    path: StrPath, *, opacity: OpacityChoice = "auto", scales: ScaleChoice = "auto", colors: ColorChoice = "auto"
) -> GaussianFile:
    """Read a file of Gaussians in the format that its ending names.

    Endings are ``.spz`` (versions 1 to 4), ``.splat``, ``.sog`` (version 2) and ``.glb``. The finest level of a
    ``lod-meta.json`` is read. A ``meta.json``, or its folder, is read as a ``.sog`` without a zip. Files with other
    endings are read by :func:`read_ply`, whose hints ``opacity``, ``scales`` and ``colors`` also count for floats of
    other formats: of a ``.glb``, and the scales of a ``.splat``. Raise SceneError if the file cannot be read, is
    damaged, or holds no finite Gaussian. Raise ValueError for an unknown encoding.

    Example:
        >>> gsmerge.write_gaussians("demo/small.spz", gsmerge.read_ply("demo/scene.ply").gaussians, overwrite=True)
        >>> len(gsmerge.read_gaussians("demo/small.spz").gaussians)
        7680
    """
    path = Path(path)
    path = path / META if path.is_dir() and (path / META).is_file() else path
    format_ = find_format(path)
    if format_.read is None:
        problem = f"expected one of {', '.join(READ_ENDINGS)}, found {format_.ending}, which is written and not read"
        raise SceneError(path, problem, "name the .ply, or the other file of Gaussians, that it was made from")
    if format_.read is ply.read_rows:
        return read_parts([path], opacity=opacity, scales=scales, colors=colors)
    hints = FileHints(opacity=opacity, scales=scales, colors=colors)
    return convert_stored([path], [format_.read(path)], hints)


def convert_stored(paths: Sequence[Path], parts: Sequence[StoredRows], hints: FileHints) -> GaussianFile:
    """Convert the rows of one or several files to Gaussians; damaged or empty rows become invalid.

    Counts and bytes in ``info`` are sums over the files. All other facts in ``info`` are those of the first file.
    """
    path = paths[0]
    stored = parts[0]
    dtype = parts[0].rows.dtype
    names = tuple(dtype.names or ())
    file_bytes = sum(path.stat().st_size + part.bytes_beside for path, part in zip(paths, parts, strict=True))
    out = _make_arrays(dtype, sum(len(part.rows) for part in parts), file_bytes)
    num_clipped, num_zero_quats = _fill_arrays(parts, out)
    change_scales, scale_note, odd_scales = choose_scales(path, stored, out, hints.scales)
    if change_scales is not None:
        parts = list(map(change_scales, parts))
        num_clipped, num_zero_quats = _fill_arrays(parts, out)
    damage = _set_aside_impossible(out) if num_clipped else ()
    empty = find_empty(path, out)
    units, color_note, open_units = choose_colors(stored, out, hints.colors)
    if units is not None:
        out["sh0"][:] = rgb_to_sh0(units.rgb(out["sh0"]))
    shown = _without(out["opacities"], empty)
    encoding, is_guess, opacity_note = choose_opacities(paths, parts, shown, hints.opacity)
    _decode_opacities(out, encoding)
    num_nonfinite = clear_invalid(path, out)
    clear_rows(out, empty)
    byte_columns = tuple(name for name in names if dtype[name].itemsize == 1)
    if byte_columns == arrays.NORMALS:
        _spread_low_degree(out["shN"])
    used = {*arrays.REQUIRED_COLUMNS, *arrays.color_columns(names), *arrays.NORMALS}
    part_notes = dict.fromkeys(note for part in parts for note in part.notes)
    info = FileInfo(
        path=str(path),
        layout=stored.layout,
        format=stored.format,
        count=len(out["valid"]),
        file_bytes=file_bytes,
        bytes_by_attribute={name: sum(part.sizes[name] for part in parts) for name in stored.sizes},
        columns=names,
        extra_columns=tuple(name for name in names if name not in used and not name.startswith("f_rest_")),
        extra_elements=stored.extra_elements,
        byte_columns=byte_columns,
        comments=stored.comments,
        sh_degree=arrays.sh_degree(out["shN"].shape[1]),
        opacity_encoding=encoding,
        opacity_guessed=is_guess,
        opacity_note=opacity_note,
        num_nonfinite=num_nonfinite,
        num_empty=len(empty),
        num_zero_quats=max(0, num_zero_quats - len(empty)),  # empty rows usually have zero quaternions
        odd_scales=odd_scales,
        color_units=units,
        color_note=color_note,
        open_units=open_units,
        adapted=(*([scale_note] if scale_note else []), *part_notes, *damage, *_describe_incomplete(out["valid"])),
    )
    return GaussianFile(valid=out.pop("valid"), gaussians=Gaussians(**out), info=info)


def _make_arrays(dtype: np.dtype[Any], n: int, file_bytes: int) -> dict[str, np.ndarray]:
    """Make uninitialised arrays of ``n`` Gaussians by name, and the array ``valid``.

    ``dtype``: the columns of the stored rows. ``file_bytes``: the size of the files. Arrays that are many times as
    large as the files lie in a temporary file.
    """
    names = tuple(dtype.names or ())
    num_higher = sum(name.startswith("f_rest_") for name in names) // 3
    has_float64 = any(dtype[name].kind == "f" and dtype[name].itemsize == 8 for name in arrays.MEANS)
    shapes = {"quats": (n, 4), "scales": (n, 3), "opacities": (n,), "sh0": (n, 1, 3), "shN": (n, num_higher, 3)}
    max_bytes = arrays.max_array_bytes(file_bytes)
    out = {"means": make_array((n, 3), np.float64 if has_float64 else np.float32), "valid": np.empty(n, np.bool_)}
    return out | {name: make_array(shape, np.float32, max_bytes) for name, shape in shapes.items()}


def _fill_arrays(parts: Sequence[StoredRows], out: dict[str, np.ndarray]) -> tuple[int, int]:
    """Fill arrays with the rows of all files; return the numbers of rows with clipped values and with zero quats."""
    # each block, after its file, and the file's first row
    blocks = list[tuple[StoredRows, slice, int]]()
    first_row = 0
    for part in parts:
        n = len(part.rows)
        block_rows = max(1, arrays.BLOCK_BYTES // part.rows.dtype.itemsize)
        blocks += [(part, slice(start, min(start + block_rows, n)), first_row) for start in range(0, n, block_rows)]
        first_row += n

    def convert(file_block: tuple[StoredRows, slice, int]) -> tuple[int, int]:
        """Convert a block of rows of a file; return its numbers of clipped values and of zero quats."""
        part, block, first_row = file_block
        rows = part.rows[block] if part.adapt is None else part.adapt(part.rows[block])
        block_out = {name: array[first_row + block.start : first_row + block.stop] for name, array in out.items()}
        counts = (0, 0)
        num_done = _convert_with_kernel(rows, block_out)
        if num_done < len(rows):
            counts = _convert_with_numpy(rows[num_done:], {name: array[num_done:] for name, array in block_out.items()})
        if block.start % FREED_ROWS < block.stop - block.start:  # the first block after every FREED_ROWS rows
            free_pages(out.values())
        return counts

    num_clipped, num_zero_quats = map(sum, zip(*parallel_map(convert, blocks), strict=True))
    return num_clipped, num_zero_quats


def _convert_with_kernel(rows: np.ndarray, out: dict[str, np.ndarray]) -> int:
    """Fill arrays with the first rows of a block by the compiled kernel; return how many rows it filled.

    The kernel stops before a row with numbers that are not finite or beyond the limits. No row is filled if a used
    column is missing or any column is not float32. Opacities are left as stored.
    """
    columns: dict[str, Any] = dict(rows.dtype.fields or {})  # name -> type and offset in bytes
    num_higher = out["shN"].shape[1]
    rest = [f"f_rest_{channel * num_higher + j}" for j in range(num_higher) for channel in range(3)]
    used = (*arrays.MEANS, *arrays.SH0, *rest, *arrays.SCALES, *arrays.QUATS, "opacity")
    types = {out["means"].dtype, *(kind for kind, *_ in columns.values())}
    if types != {np.dtype(np.float32)} or not columns.keys() >= set(used):
        return 0
    offsets = [offset for _, offset, *_ in (columns[name] for name in used)]
    column_ids = np.array([offset // np.dtype(np.float32).itemsize for offset in offsets], np.int32)
    values = rows.view(np.float32).reshape(len(rows), -1)
    sh0, shN = (out[name].reshape(len(rows), -1) for name in ("sh0", "shN"))
    limits = arrays.MAX_POSITION, MAX_HARMONIC, arrays.MAX_LOG_SCALE
    num_done = convert_rows(
        values, column_ids, *limits, out["means"], out["quats"], out["scales"], out["opacities"], sh0, shN
    )
    out["valid"][:num_done] = True
    return num_done


def _convert_with_numpy(rows: np.ndarray, out: dict[str, np.ndarray]) -> tuple[int, int]:
    """Fill arrays with rows of any type; return how many rows have clipped values, and how many have zero quats.

    Opacities are left as stored.
    A row is valid if its numbers are finite, except that a logit may be infinite and a scale zero.
    """
    color_names = arrays.color_columns(rows.dtype.names)
    num_higher = out["shN"].shape[1]
    rest_names = [f"f_rest_{channel * num_higher + j}" for j in range(num_higher) for channel in range(3)]

    def read(names: Sequence[str]) -> np.ndarray:
        """Return columns side by side, ``[n,len(names)]`` float32."""
        values = np.empty((len(rows), len(names)), np.float32)
        for j, name in enumerate(names):
            values[:, j] = rows[name]
        return values

    with np.errstate(all="ignore"):
        means, colors, rest, quats = (read(names) for names in (arrays.MEANS, color_names, rest_names, arrays.QUATS))
        log_scales = read(arrays.SCALES)
        opacities = read(["opacity"])[:, 0]
        finite = [np.isfinite(values).all(1) for values in (means, colors, rest, quats)]
        out["valid"][:] = np.logical_and.reduce([*finite, ~np.isnan(opacities), (log_scales < np.inf).all(1)])
        limits = ((colors, MAX_HARMONIC), (rest, MAX_HARMONIC), (log_scales, arrays.MAX_LOG_SCALE))
        is_clipped = (np.abs(means) > arrays.MAX_POSITION).any(1)
        is_clipped |= np.logical_or.reduce([(np.abs(values) > limit).any(1) for values, limit in limits])
        for values, limit in limits:
            np.clip(values, -limit, limit, out=values)
        for j, name in enumerate(arrays.MEANS):
            out["means"][:, j] = rows[name]
        for j, name in enumerate(color_names):
            white = 255 if rows.dtype[name].kind == "u" else 1
            out["sh0"][:, 0, j] = colors[:, j] if name in arrays.SH0 else rgb_to_sh0(colors[:, j] / white)
        out["shN"][:] = rest.reshape(out["shN"].shape)
        out["scales"][:] = exp(log_scales)
        out["opacities"][:] = opacities
        w, x, y, z = quats.T
        squared_lengths = w * w + x * x + y * y + z * z
        inverse_lengths = 1 / np.sqrt(squared_lengths)
        for j, column in enumerate(quats.T):
            np.multiply(column, inverse_lengths, out=out["quats"][:, j])
        is_zero = np.zeros(len(rows), np.bool_)
        # Quaternions whose squares under- or overflow in float32 are normalised again in float64. Zero quaternions
        # become the identity
        extreme = np.flatnonzero(~((squared_lengths > 1e-30) & (squared_lengths < 1e30)))
        if len(extreme):
            exact = quats[extreme].astype(np.float64)
            length = np.linalg.norm(exact, axis=1)
            is_zero[extreme] = length == 0
            exact[length == 0] = (1, 0, 0, 0)
            out["quats"][extreme] = exact / np.where(length == 0, 1, length)[:, None]
    return int((is_clipped & out["valid"]).sum()), int((is_zero & out["valid"]).sum())


def _without(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return values that are NaN in some ``rows``."""
    out = values if len(rows) == 0 else values.copy()
    out[rows] = np.nan
    return out


def _decode_opacities(out: dict[str, np.ndarray], encoding: str) -> None:
    """Convert stored opacities to [0, 1], in place; rows with infinite values other than logits become invalid."""
    opacities = out["opacities"]
    if encoding == "raw":
        out["valid"] &= np.isfinite(opacities)
        np.clip(opacities, 0, 1, out=opacities)
    else:
        with np.errstate(all="ignore"):
            opacities[:] = exp(np.negative(opacities, out=opacities))
            np.add(opacities, 1, out=opacities)
            np.reciprocal(opacities, out=opacities)


def _spread_low_degree(shN: np.ndarray) -> None:
    """Put harmonics of degree 1 or 2 from a file of Long-LRM in the right places of ``shN [n,15,3]``, in place.

    For degree 1 or 2, Long-LRM fills only the first 9 or 24 of its 45 columns. The filled columns hold all harmonics of
    red, then of green, then of blue.
    """
    if shN.shape[1] != 15:
        return
    columns = shN.transpose(0, 2, 1).reshape(len(shN), 45)
    last_used = int(np.flatnonzero(columns.any(0)).max(initial=-1))
    for num_higher in (3, 8):  # of degrees 1 and 2
        if 0 <= last_used < 3 * num_higher:
            shN[:] = 0
            shN[:, :num_higher] = columns[:, : 3 * num_higher].reshape(-1, 3, num_higher).transpose(0, 2, 1)
            return


def clear_invalid(path: str | Path, out: dict[str, np.ndarray]) -> int:
    """Make invalid rows transparent, in place, and return their number; raise SceneError if too few rows are valid."""
    valid = out["valid"]
    invalid = np.flatnonzero(~valid)
    num_valid = len(valid) - len(invalid)
    min_valid = 0.002  # least share of valid rows in a file
    if len(invalid) and num_valid < min_valid * len(valid):
        number = f"{len(invalid):,} of" if num_valid else "all"
        rows = f"{number} {len(valid):,} rows"
        problem = f"expected finite Gaussians, found NaN, inf or numbers that no scene has in {rows}"
        raise SceneError(path, problem, "export it again")
    clear_rows(out, invalid)
    return len(invalid)


def find_empty(path: str | Path, out: dict[str, np.ndarray]) -> np.ndarray:
    """Return the valid rows that are no Gaussians, but only pad the file.

    A row at the origin pads the file if it is not rotated, round and grey, as a row of zeros is. VolSplat pads with
    many equal rows at the origin. If all valid rows are padding, up to 15 count as Gaussians, and more raise
    SceneError.
    """
    rows = np.flatnonzero((out["means"][:, 0] == 0) & out["valid"])
    rows = rows[(out["means"][rows] == 0).all(1)]
    if len(rows) == 0:
        return rows
    scales = out["scales"][rows]
    sh0 = out["sh0"][rows, 0]
    empty = (out["quats"][rows] == (1, 0, 0, 0)).all(1) & (scales == scales[:, :1]).all(1) & (sh0 == 0).all(1)
    min_padding = 16  # from this number on, equal rows at the origin are padding; fewer may be Gaussians
    if len(rows) >= min_padding:
        attributes = np.concatenate([scales, out["opacities"][rows, None], sh0], 1)
        empty |= (attributes == lower_median(attributes)).all(1)
    rows = rows[empty]
    if len(rows) == np.count_nonzero(out["valid"]):
        if len(rows) < min_padding:
            return rows[:0]  # none
        problem = f"expected Gaussians, found only {len(rows):,} rows at the origin that are empty or equal"
        raise SceneError(path, problem, "export it again, since the export may have been interrupted")
    return rows


def clear_rows(out: dict[str, np.ndarray], rows: np.ndarray) -> None:
    """Make ``rows`` invalid, transparent and grey, in place.

    Each of these rows gets the position and scales of the valid row before it, so that the scene does not grow.
    """
    if len(rows) == 0:
        return
    out["valid"][rows] = False
    valid_rows = np.flatnonzero(out["valid"])
    previous = valid_rows[np.maximum(np.searchsorted(valid_rows, rows) - 1, 0)]
    for name in ("means", "scales"):
        out[name][rows] = out[name][previous]
    for name, value in {"quats": (1, 0, 0, 0), "opacities": 0, "sh0": 0, "shN": 0}.items():
        out[name][rows] = value


def _set_aside_impossible(out: dict[str, np.ndarray]) -> list[str]:
    """Make rows invalid, in place, if they have numbers that no scene has; warn if there are many such rows."""
    is_possible = (out["scales"] < exp(np.float32(arrays.MAX_LOG_SCALE))).all(1)
    is_possible &= (np.abs(out["means"]) <= arrays.MAX_POSITION).all(1)
    is_possible &= (np.abs(np.concatenate([out["sh0"], out["shN"]], 1)) < MAX_HARMONIC).all((1, 2))
    count = np.count_nonzero(out["valid"] & ~is_possible)
    out["valid"] &= is_possible
    what = f"{count:,} of {len(is_possible):,} rows have numbers that no scene has, as in a damaged file"
    return [Doubt(f"{what}; copy it again, in binary mode")] if count > arrays.MAX_STRAY * len(is_possible) else []


def _describe_incomplete(valid: np.ndarray) -> tuple[str, ...]:
    """Warn if the last rows, or most rows, of a file are invalid; empty for other files."""
    valid_rows = np.flatnonzero(valid)
    num_last = len(valid) - 1 - int(valid_rows[-1])  # rows after the last Gaussian
    num_invalid = len(valid) - len(valid_rows)
    if num_last > 1 and num_last > num_invalid - num_last:
        which = f"the last {num_last:,}"
        remedy = "export it again, since the export may have been interrupted"
    elif num_invalid > len(valid_rows):
        which = f"{num_invalid:,}"
        remedy = "export the file again unless a mask emptied them"
    else:
        return ()
    return (Doubt(f"{which} of {len(valid):,} rows are no Gaussians; {remedy}"),)
