"""Read and join additional columns of PLY files, such as labels, for outputs that have the same rows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.formats import ply
from gsmerge.io.formats.columns import describes_places, list_names
from gsmerge.io.formats.read_gaussians import FileInfo
from gsmerge.io.formats.rows import read_columns
from gsmerge.io.formats.table import PLY, Format


def read_extra_columns(info: FileInfo) -> np.ndarray:
    """Read the columns of a file that do not belong to Gaussians, as a structured array ``[n]``.

    The array has no fields if all columns belong to Gaussians. Raise SceneError if the file changed or cannot be read.
    """
    path = Path(info.path)
    if not info.extra_columns:
        return np.empty(info.count, [])
    rows = ply.read_rows(path).rows
    if len(rows) != info.count:
        problem = f"expected {info.count:,} rows, found {len(rows):,}, since the file changed while it was read"
        raise SceneError(path, problem, "run the command again")
    return read_columns(rows, info.extra_columns)


def join_extra_columns(parts: Sequence[np.ndarray]) -> tuple[np.ndarray, list[str]]:
    """Join the rows of files, with only the columns that all files have; also return the names of the other columns."""
    types = [
        {name: part.dtype[name] for name in part.dtype.names or ()} for part in parts
    ]  # of each file: name -> type
    names = dict.fromkeys(name for file_types in types for name in file_types)
    common = [name for name in names if len({file_types.get(name) for file_types in types}) == 1]
    out = np.empty(sum(map(len, parts)), [(name, types[0][name]) for name in common])
    for name in common:
        out[name] = np.concatenate([part[name] for part in parts])
    return out, [name for name in names if name not in common]


def describe_extra_columns(columns: np.ndarray, missing: Sequence[str], format_: Format, *, moves: bool) -> list[str]:
    """Note which additional columns an output in ``format_`` keeps. Each note is a sentence without a full stop.

    ``missing``: columns that some inputs lack. ``moves``: whether the positions of Gaussians are changed.
    """
    names = list(columns.dtype.names or ())
    notes = list[str]()
    if missing:
        notes.append(f"columns that some files lack or have in other types are left out: {list_names(missing)}")
    if names and format_ is not PLY:
        notes.append(f"columns that {format_.ending} cannot store are left out: {list_names(names)}")
    elif names:
        notes.append(f"columns that are copied unchanged: {list_names(names)}")
        positions = [name for name in names if describes_places(name)]
        if moves and positions:
            notes.append(f"columns that may hold positions or directions are not moved: {list_names(positions)}")
    return notes
