"""Write Gaussians in the format that the ending of a file's name chooses, and note what the format does not keep."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from os import fspath
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from gsmerge.arrays import distinct
from gsmerge.io.atomic import AddOutput, atomic_output
from gsmerge.io.formats import ply
from gsmerge.io.formats.read_gaussians import read_gaussians
from gsmerge.io.formats.table import FILES, OUTPUT_FORMATS, PLY, Contents, output_format
from gsmerge.method.geometry.transforms import medians
from gsmerge.runtime.arguments import check_arguments
from gsmerge.types import Gaussians, StrPath

# Limit of the mean square of the distances by which rounding moves Gaussians. Above the limit, renders change visibly;
# at the limit, a PSNR of 27 dB drops by .05 dB. A distance is divided by the Gaussian's size, and a quotient above 1
# counts as 1. In scenes around the origin, the mean square is at most a tenth of the limit.
VISIBLE_MEAN_SQUARE = 0.005
ROUNDING_GAUSSIANS = 1 << 17  # number of Gaussians from which the mean is estimated


def limit_notes(path: StrPath, sh_degree: int, count: int) -> list[str]:
    """Note if the format of a path leaves out harmonics, or if public readers of the format refuse ``count`` Gaussians.

    Raise UsageError if no format has the ending of the path.
    """
    format_ = output_format(path)
    notes = list[str]()
    if sh_degree > format_.max_degree:
        notes.append(format_.harmonics_note.format(ending=format_.ending, degree=format_.max_degree))
    if count > format_.max_gaussians:
        problem = f"public readers of {format_.ending} stop at {format_.max_gaussians:,} Gaussians"
        notes.append(f"{problem}: write a .ply or .sog, or fewer")
    return notes


def level_output(output: Path, level: int) -> Path:
    """Return the path of a coarser level of detail, such as ``out.level1.ply`` for level 1 of ``out.ply``."""
    stem_length = len(output.name) - len(output_format(output, alone=True).ending)
    return output.with_name(f"{output.name[:stem_length]}.level{level}{output.name[stem_length:]}")


def write_apart(add: AddOutput, path: Path, temporary: Path, contents: Contents) -> dict[Path, list[Path]]:
    """Write each level of detail of ``contents`` to a separate file.

    ``add`` makes the temporary file of a path; ``temporary`` is that of ``path``. Return the path of each level, with a
    list of its only temporary file.
    """
    written = {path: [temporary]}
    format_ = output_format(path, alone=True)
    for level in range(1, len(contents.levels)):
        written[level_output(path, level)] = [add(level_output(path, level))]
    for (file,), gaussians in zip(written.values(), contents.levels, strict=True):
        if format_.encode is not None:
            check_readable(gaussians, contents.comments)
            file.write_bytes(format_.encode(gaussians, contents))
            continue
        degree = min(gaussians.sh_degree, format_.max_degree)
        normals = contents.options.normals
        # Additional columns belong to the rows of one level
        _write_ply(
            file, gaussians, overwrite=True, sh_degree=degree, comments=contents.comments, normals=normals,
            extra_columns=contents.extra_columns,
        )  # fmt: skip
    return written


@check_arguments
def write_gaussians(
    path: StrPath,
    gaussians: Gaussians,
    *,
    overwrite: bool = False,
    comments: Sequence[str] = (),
    ending: str | None = None,
    normals: bool = True,
) -> None:
    """Write Gaussians to a file; the ending of its name, one of ``OUTPUT_FORMATS``, chooses the format.

    All formats except ``.ply`` quantise numbers. In ``.glb`` y points up, so Gaussians are rotated by half a turn about
    z. Harmonics of degree 4, which only :func:`write_ply` writes, are left out.

    Args:
        path: The file. It is written completely or not at all.
        gaussians: Gaussians with finite values.
        overwrite: Replace an existing file.
        comments: Lines for the header of a ``.ply``; ``.spz`` and ``.sog`` keep "SplatRenderMode: mip".
        ending: Ending of a format, such as ".ply", which replaces the ending of the path in the choice of the format.
        normals: Write the columns of normals to a ``.ply``, as :func:`write_ply` does.

    Raises:
        UsageError: If the ending is unknown.
        SceneError: If the file exists or cannot be written.
        ValueError: If there is no Gaussian, if there is NaN or inf, if a comment is not a line of ASCII, or if comments
            have more than half a million characters.

    Example:
        >>> gaussians = gsmerge.compact("demo", effort="draft", budget=300).gaussians
        >>> gsmerge.write_gaussians("demo/small.splat", gaussians, overwrite=True)
    """
    format_ = output_format(ending or path, alone=True)
    if format_.encode is None:
        degree = min(gaussians.sh_degree, format_.max_degree)
        _write_ply(path, gaussians, overwrite=overwrite, sh_degree=degree, comments=comments, normals=normals)
        return
    check_readable(gaussians, comments)
    with atomic_output(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(format_.encode(gaussians, Contents([gaussians], comments)))


@check_arguments
def write_ply(
    path: StrPath,
    gaussians: Gaussians,
    *,
    overwrite: bool = False,
    sh_degree: int | None = None,
    comments: Sequence[str] = (),
    normals: bool = True,
) -> None:
    """Write Gaussians in INRIA's column order, binary little-endian float32.

    Opacities become finite logits (within +-16), and scales become finite logarithms (within +-30). Quaternions are
    normalised.

    Args:
        path: The file. It is written completely or not at all.
        gaussians: Gaussians with finite values.
        overwrite: Replace an existing file.
        sh_degree: Drop harmonics above this degree. None: keep all.
        comments: Lines for the header, such as those that :func:`gsmerge.io.kept_comments` returns for another file.
        normals: Write three columns of zeros, 12 bytes per Gaussian. No renderer uses normals, but a few readers, such
            as SIBR's, expect the three columns.

    Raises:
        SceneError: If the file exists or cannot be written.
        ValueError: If the name has the ending of another format than ``.ply``, if there is no Gaussian, if there is NaN
            or inf, if ``sh_degree`` is above that of the Gaussians, if a comment is not a line of ASCII, or if comments
            have more than half a million characters.

    Example:
        >>> result = gsmerge.compact("demo", effort="draft", budget=300)
        >>> gsmerge.write_ply("demo/small.ply", result.gaussians, overwrite=True)
    """
    if fspath(path).lower().endswith(tuple(ending for ending in OUTPUT_FORMATS if ending != PLY.ending)):
        raise ValueError(f"path: expected a name that ends in .ply, got {fspath(path)}; call write_gaussians for it")
    _write_ply(path, gaussians, overwrite=overwrite, sh_degree=sh_degree, comments=comments, normals=normals)


def _write_ply(
    path: StrPath,
    gaussians: Gaussians,
    overwrite: bool,
    sh_degree: int | None,
    comments: Sequence[str],
    normals: bool,
    extra_columns: np.ndarray | None = None,
) -> None:
    """Write a ``.ply`` as :func:`write_ply` does, but to a file of any name, and with ``extra_columns``."""
    check_readable(gaussians, comments)
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    if not 0 <= degree <= gaussians.sh_degree:
        raise ValueError(f"sh_degree: expected 0 to {gaussians.sh_degree}, got {sh_degree}")
    with atomic_output(path, overwrite=overwrite) as temporary, temporary.open("wb") as file:
        file.writelines(ply.ply_blocks(gaussians, degree, comments, normals=normals, extra=extra_columns))


def check_readable(gaussians: Gaussians, comments: Sequence[str]) -> None:
    """Raise ValueError for content that readers would refuse: no Gaussians, or invalid comments."""
    if len(gaussians) == 0:
        raise ValueError("gaussians: expected at least one, got none")
    length = sum(len(f"comment {comment}\n") for comment in comments)
    if length > ply.MAX_HEADER_BYTES // 2:
        raise ValueError(f"comments: expected at most {ply.MAX_HEADER_BYTES // 2:,} characters, got {length:,}")
    if not all(comment.isascii() and comment.isprintable() for comment in comments):
        raise ValueError(f"comments: expected printable lines of ASCII, got {list(comments)}")


def output_notes(path: StrPath, gaussians: Gaussians) -> list[str]:
    """Note what a path's format leaves out, and how far its rounding moves Gaussians; raise UsageError without one."""
    return limit_notes(path, gaussians.sh_degree, len(gaussians)) + rounding_notes(path, gaussians)


def rounding_notes(path: StrPath, gaussians: Gaussians) -> list[str]:
    """Note how far a format's rounding of positions moves Gaussians; no notes if renders do not change visibly."""
    if len(gaussians) == 0:
        return []
    format_ = output_format(path)
    columns = gaussians.numpy()
    # The sample includes the Gaussians at the least and largest positions, by which formats choose the steps of
    # rounding
    extremes = columns.means.argmin(axis=0), columns.means.argmax(axis=0)
    rows = distinct(np.concatenate([np.arange(0, len(gaussians), len(gaussians) // ROUNDING_GAUSSIANS + 1), *extremes]))
    means = columns.means.take(rows, axis=0).astype(np.float64)
    scales = columns.scales.take(rows, axis=0)
    sizes = np.sort(scales, axis=1)[:, 1]  # a Gaussian is as large as its second largest scale
    with np.errstate(over="ignore"):
        moves = np.abs(format_.round_means(means) - means).max(axis=1)
    mean_square = float(np.square(np.minimum(moves / np.maximum(sizes, 1e-30), 1)).mean())
    if mean_square <= VISIBLE_MEAN_SQUARE:
        return []
    center = medians(means)
    shift = ",".join(f"{-float(f'{coordinate:.3g}'):.0f}" for coordinate in center)
    remedy = f"move the input and its cameras near the origin first, with gsmerge convert --translate={shift}"
    if np.abs(center).max() < np.abs(means - center).max():  # the scene is wider than its distance from the origin
        remedy = ("" if format_.round_means is PLY.round_means else "write a .ply, or ") + "crop far Gaussians"
    problem = f"positions so far from the origin lose digits in {format_.ending}"
    return [f"{problem}, and Gaussians move by about {100 * mean_square**0.5:.0f} % of their size; {remedy}"]


def round_as_written(path: StrPath, gaussians: Gaussians) -> Gaussians:
    """Return Gaussians as they are after writing and reading a file in the format of ``path``.

    Gaussians are written to a temporary file and read from it, if the format is coarse or moves Gaussians visibly.
    Otherwise only the harmonics that it cannot store are left out.
    """
    format_ = output_format(path)
    format_ = next((row for row in FILES if row.ending == format_.inside), format_)
    if format_.coarse or rounding_notes(path, gaussians):
        with TemporaryDirectory() as folder:
            write_gaussians(Path(folder) / f"a{format_.ending}", gaussians)
            return read_gaussians(Path(folder) / f"a{format_.ending}").gaussians
    if gaussians.sh_degree > format_.max_degree:
        return replace(gaussians, shN=gaussians.shN[:, : (format_.max_degree + 1) ** 2 - 1])
    return gaussians
