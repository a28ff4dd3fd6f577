"""Gaussians to a file, in the format that its name asks for."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from gsmerge.errors import UsageError
from gsmerge.io.atomic import atomic_output
from gsmerge.io.formats import compressed_writer, splat_writer, spz_writer
from gsmerge.io.formats.compressed_writer import compressed_bytes
from gsmerge.io.formats.ply_writer import write_ply
from gsmerge.io.formats.splat_writer import splat_bytes
from gsmerge.io.formats.spz_writer import spz_bytes
from gsmerge.types import Gaussians

# File endings, the longest first, and the highest degree of the harmonics that there is room for.
OUTPUT_FORMATS = {
    ".compressed.ply": compressed_writer.MAX_DEGREE,
    ".ply": 4,
    ".spz": spz_writer.MAX_DEGREE,
    ".splat": splat_writer.MAX_DEGREE,
}


def output_format(path: str | os.PathLike[str]) -> str:
    """The ending of an output's name that says how it is written.

    Raises:
        UsageError: If it is none of ``OUTPUT_FORMATS``.
    """
    name = Path(path).name.lower()
    found = next((ending for ending in OUTPUT_FORMATS if name.endswith(ending)), None)
    if found is None:
        *most, last = OUTPUT_FORMATS
        raise UsageError(f"{path}: expected a name that ends in {', '.join(most)} or {last}")
    return found


def lost_harmonics(path: str | os.PathLike[str], sh_degree: int) -> str | None:
    """What a format has no room for, as a note; None if it holds everything.

    Raises:
        UsageError: As :func:`output_format`.
    """
    ending = output_format(path)
    most = OUTPUT_FORMATS[ending]
    return None if sh_degree <= most else f"{ending} has no room for harmonics above degree {most}: left out"


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
            file.write(compressed_bytes(gaussians, comments))
        else:
            file.write(spz_bytes(gaussians) if ending == ".spz" else splat_bytes(gaussians))
