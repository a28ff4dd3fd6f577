"""Gaussians to a file, in the format that its name asks for."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsmerge.errors import UsageError
from gsmerge.io.atomic import atomic_output
from gsmerge.io.formats import compressed, spz_writer
from gsmerge.io.formats.arrays import to_bytes, to_columns
from gsmerge.io.formats.ply_writer import write_ply
from gsmerge.types import Gaussians

# ``.splat``: 32 bytes per Gaussian and no header, the format of antimatter15/splat that most viewers read. Quaternions
# wxyz are bytes 128 + 128 q; there is no room for harmonics above degree 0.
SPLAT_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("colors", "u1", 4), ("quats", "u1", 4)])

# File endings, the longest first, and the highest degree of the harmonics that there is room for.
OUTPUT_FORMATS = {
    ".compressed.ply": compressed.MAX_DEGREE,
    ".ply": 4,
    ".spz": spz_writer.MAX_DEGREE,
    ".splat": 0,
}


def output_format(path: str | os.PathLike[str]) -> str:
    """The ending of an output's name that says how it is written.

    Raises:
        UsageError: If it is none of ``OUTPUT_FORMATS``.
    """
    name = Path(path).name.lower()
    ending = next((ending for ending in OUTPUT_FORMATS if name.endswith(ending)), None)
    if ending is None:
        *first, last = OUTPUT_FORMATS
        raise UsageError(f"{path}: expected a name that ends in {', '.join(first)} or {last}")
    return ending


def lost_harmonics(path: str | os.PathLike[str], sh_degree: int) -> str | None:
    """What a format has no room for, as a note; None if it holds everything.

    Raises:
        UsageError: As :func:`output_format`.
    """
    ending = output_format(path)
    highest = OUTPUT_FORMATS[ending]
    return None if sh_degree <= highest else f"{ending} has no room for harmonics above degree {highest}: left out"


def write_gaussians(
    path: str | os.PathLike[str],
    gaussians: Gaussians,
    *,
    overwrite: bool = False,
    comments: Sequence[str] = (),
    ending: str | None = None,
) -> None:
    """Write Gaussians as ``.ply``, ``.compressed.ply``, ``.spz`` or ``.splat``, by the ending of the name.

    All but ``.ply`` quantise; none of them changes the frame of the Gaussians.

    Args:
        path: The file; complete or not there at all.
        gaussians: Finite values.
        overwrite: Replace an existing file.
        comments: Lines for the header of the two that have one.
        ending: Format to write instead of the name's.

    Raises:
        UsageError: If the name ends in none of these.
        SceneError: If the file exists or cannot be written.
        ValueError: If there is NaN or inf, or a comment is no line of ASCII.
    """
    ending = output_format(path) if ending is None else ending
    if ending == ".ply":
        write_ply(path, gaussians, overwrite=overwrite, comments=comments)
        return
    if not all(comment.isascii() and comment.isprintable() for comment in comments):
        raise ValueError(f"comments: expected printable lines of ASCII, got {list(comments)}")
    with atomic_output(path, overwrite=overwrite) as temporary, temporary.open("wb") as file:
        if ending == ".compressed.ply":
            file.write(compressed.compressed_bytes(gaussians, comments))
        else:
            file.write(spz_writer.spz_bytes(gaussians) if ending == ".spz" else splat_bytes(gaussians))


def splat_bytes(gaussians: Gaussians) -> bytes:
    """Content of a ``.splat`` file.

    Raises:
        ValueError: If there is NaN or inf.
    """
    columns = to_columns(gaussians, OUTPUT_FORMATS[".splat"])
    rows = np.empty(len(columns), SPLAT_ROW)
    rows["means"], rows["scales"] = columns.means, np.exp(columns.log_scales)
    rows["colors"] = to_bytes(255 * np.concatenate([columns.colors, columns.opacities[:, None]], 1))
    rows["quats"] = to_bytes(128 * columns.quats + 128)
    return rows.tobytes()
