"""Writers of Gaussians, by the format that a file's name asks for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsmerge.errors import UsageError
from gsmerge.io.atomic import AddOutput, atomic_output, atomic_outputs
from gsmerge.io.formats import compressed, glb, ply_file, sog, splat, spz, streamed
from gsmerge.io.formats.arrays import to_columns
from gsmerge.kernels.elementary import log, log1p
from gsmerge.types import Gaussians, StrPath

# File endings, the longest first, and the highest degree of the harmonics that there is room for.
OUTPUT_FORMATS = {
    ".compressed.ply": compressed.MAX_DEGREE,
    ".ply": 4,
    ".spz": spz.MAX_DEGREES[3],
    ".sog": sog.MAX_DEGREE,
    ".splat": splat.MAX_DEGREE,
    ".glb": glb.MAX_DEGREE,
}


def output_format(path: StrPath, spz_version: int = 3, *, levels: bool = False) -> str:
    """Return the ending of a name, by which its format is chosen; UsageError if unknown or a package is missing.

    ``levels``: the name may be that of an index of levels of detail, which is returned.
    """
    if levels and Path(path).name == streamed.INDEX:
        return streamed.INDEX
    name = Path(path).name.lower()
    ending = next((ending for ending in OUTPUT_FORMATS if name.endswith(ending)), None)
    if ending is None:
        *first, last = OUTPUT_FORMATS
        index = f", or the name {streamed.INDEX}" if levels else ""
        raise UsageError(f"{path}: expected a name that ends in {', '.join(first)} or {last}{index}")
    if ending == ".spz" and spz_version == 4:
        spz.zstandard()
    return ending


def lost_harmonics(path: StrPath, sh_degree: int, spz_version: int = 3) -> str | None:
    """Describe the harmonics that a format has no room for; None if it holds all, UsageError on an unknown one."""
    ending = output_format(path, levels=True)
    room = {**OUTPUT_FORMATS, ".spz": spz.MAX_DEGREES[spz_version], streamed.INDEX: streamed.MAX_DEGREE}
    highest = room[ending]
    return None if sh_degree <= highest else f"{ending} has no room for harmonics above degree {highest}: left out"


def write_gaussians(
    path: StrPath,
    gaussians: Gaussians,
    *,
    overwrite: bool = False,
    comments: Sequence[str] = (),
    ending: str | None = None,
    normals: bool = True,
    spz_version: int = 3,
) -> None:
    """Write Gaussians in one of ``OUTPUT_FORMATS``, by the ending of the name.

    All but ``.ply`` and ``.glb`` quantise; none of them changes the frame of the Gaussians.

    Args:
        path: The file; complete or not there at all.
        gaussians: Finite values.
        overwrite: Replace an existing file.
        comments: Lines for the header of the two that have one; ``.spz`` and ``.sog`` keep "SplatRenderMode: mip".
        ending: Format to write instead of the name's.
        normals: Of a ``.ply``, as of :func:`write_ply`.
        spz_version: Of a ``.spz``: 3, which most programs read, or 4, which has room for harmonics of degree 4 and
            needs ``zstandard``.

    Raises:
        UsageError: If the name ends in none of these, or ``zstandard`` is needed and not installed.
        SceneError: If the file exists or cannot be written.
        ValueError: If there is NaN or inf, a comment is no line of ASCII, or there is no such version.
    """
    ending = output_format(path) if ending is None else ending
    if ending == ".ply":
        write_ply(path, gaussians, overwrite=overwrite, comments=comments, normals=normals)
        return
    _check_comments(comments)
    mip = ply_file.MIP_COMMENT in comments
    with atomic_output(path, overwrite=overwrite) as temporary:
        if ending == ".compressed.ply":
            content = compressed.compressed_bytes(gaussians, comments)
        elif ending == ".spz":
            content = spz.spz_bytes(gaussians, mip=mip, version=spz_version)
        elif ending == ".sog":
            content = sog.sog_bytes(gaussians, mip=mip)
        else:
            content = splat.splat_bytes(gaussians) if ending == ".splat" else glb.glb_bytes(gaussians)
        temporary.write_bytes(content)


def write_levels(
    path: StrPath, levels: Sequence[Gaussians], *, overwrite: bool = False, comments: Sequence[str] = ()
) -> None:
    """Write levels of detail as Streamed SOG: an index, and chunks in folders beside it.

    A viewer loads the chunks that it sees, at the level that fits. All files are written, or none; the chunks of
    an index that is replaced are removed.

    Args:
        path: The index, a ``lod-meta.json``; its folder is made if it is missing.
        levels: Finite values, the finest level first.
        overwrite: Replace an existing index.
        comments: Lines as of :func:`write_gaussians`, of which "SplatRenderMode: mip" is kept.

    Raises:
        UsageError: If the name is another one.
        SceneError: If the file exists or cannot be written.
        ValueError: If there is NaN or inf, no Gaussian at some level, or a comment is no line of ASCII.
    """
    path = Path(path)
    if path.name != streamed.INDEX:
        raise UsageError(f"{path}: expected the name {streamed.INDEX}, by which viewers recognise the format")
    with atomic_outputs(overwrite=overwrite) as add:
        add_levels(add, path, add(path, make_folder=True), levels, comments)
    streamed.remove_unused_chunks(path)


def add_levels(
    add: AddOutput, path: Path, index: Path, levels: Sequence[Gaussians], comments: Sequence[str] = ()
) -> list[tuple[Path, list[Path]]]:
    """Write levels of detail as some of several outputs, ``index`` in place of ``path``.

    Returns of each level the ``meta.json`` of its first chunk, as it will be named, and all files as they are now.
    """
    _check_comments(comments)
    firsts: dict[str, Path] = {}
    written: dict[str, list[Path]] = {}
    for name, data in streamed.streamed_files(levels, mip=ply_file.MIP_COMMENT in comments).items():
        if name == streamed.INDEX:
            index.write_bytes(data)
            continue
        target, level = path.parent / name, name.partition("_")[0]
        same = target.is_file() and target.read_bytes() == data  # its name has a hash of its content
        written.setdefault(level, []).append(target if same else add(target, make_folder=True))
        if not same:
            written[level][-1].write_bytes(data)
        if target.name == sog.META:
            firsts.setdefault(level, target)
    return [(firsts[level], files) for level, files in written.items()]


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

    Opacities become finite logits (within +-16), scales finite logarithms (within +-30), quaternions unit ones.

    Args:
        path: The file; complete or not there at all.
        gaussians: Finite values.
        overwrite: Replace an existing file.
        sh_degree: Drop harmonics above this degree; None keeps all.
        comments: Lines for the header, such as :func:`gsmerge.io.kept_comments` of another file.
        normals: Write three columns of zeros that no renderer uses but a few readers, such as SIBR's, expect: 12 bytes
            per Gaussian.

    Raises:
        SceneError: If the file exists or cannot be written.
        ValueError: If there is NaN or inf, fewer harmonics than asked for, or a comment is no line of ASCII.
    """
    _check_comments(comments)
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    if not 0 <= degree <= gaussians.sh_degree:
        raise ValueError(f"sh_degree: expected 0 to {gaussians.sh_degree}, got {sh_degree}")
    header, num_columns = _header(len(gaussians), degree, comments, normals=normals)
    block = max(1, ply_file.BLOCK_BYTES // (4 * num_columns))
    with atomic_output(path, overwrite=overwrite) as temporary, temporary.open("wb") as file:
        file.write(header)
        for start in range(0, len(gaussians), block):
            columns = to_columns(gaussians[start : start + block], degree, start)
            logits = log(columns.opacities) - log1p(-columns.opacities)  # 0 and 1 are clipped, impossible ones NaN
            parts = [
                columns.means,
                np.zeros((len(columns), 3 * normals)),
                columns.sh0,
                columns.harmonics.transpose(0, 2, 1).reshape(len(columns), 3 * columns.harmonics.shape[1]),
                np.clip(logits, -ply_file.MAX_LOGIT, ply_file.MAX_LOGIT)[:, None],
                columns.log_scales,
                columns.quats,
            ]
            rows = np.concatenate(parts, axis=1, dtype="<f4", casting="same_kind")
            if not np.isfinite(rows).all():
                raise ValueError(f"expected finite Gaussians, got an opacity outside [0, 1] in the rows from {start}")
            file.write(rows.data)


def _check_comments(comments: Sequence[str]) -> None:
    if not all(comment.isascii() and comment.isprintable() for comment in comments):
        raise ValueError(f"comments: expected printable lines of ASCII, got {list(comments)}")


def _header(count: int, sh_degree: int, comments: Sequence[str] = (), *, normals: bool = True) -> tuple[bytes, int]:
    """Return the header of a float32 ``.ply`` of ``count`` Gaussians, and its number of columns."""
    num_rest = 3 * ((sh_degree + 1) ** 2 - 1)
    start = (*ply_file.MEANS, *ply_file.NORMALS) if normals else ply_file.MEANS
    names = [
        *start,
        *ply_file.SH0,
        *(f"f_rest_{i}" for i in range(num_rest)),
        "opacity",
        *ply_file.SCALES,
        *ply_file.QUATS,
    ]
    lines = ["ply", "format binary_little_endian 1.0", f"comment {ply_file.LOGIT_COMMENT}"]
    lines += [*(f"comment {comment}" for comment in comments), f"element vertex {count}"]
    lines += [*(f"property float {name}" for name in names), "end_header", ""]
    return "\n".join(lines).encode("ascii"), len(names)


def file_bytes(count: int, sh_degree: int) -> int:
    """Return the size in bytes of the ``.ply`` of ``count`` Gaussians, without comments."""
    header, num_columns = _header(count, sh_degree)
    return len(header) + 4 * num_columns * count


def count_for_bytes(max_bytes: int, sh_degree: int) -> int:
    """Return the largest number of Gaussians whose ``.ply`` has at most ``max_bytes``; UsageError if none fits."""
    if not 0 <= sh_degree <= 4:
        raise ValueError(f"sh_degree: expected 0 to 4, got {sh_degree}")
    least = file_bytes(1, sh_degree)
    if max_bytes < least:
        raise UsageError(f"budget: expected at least {least} bytes for one Gaussian, got {max_bytes}")
    count = (max_bytes - file_bytes(0, sh_degree)) // (file_bytes(2, sh_degree) - least)
    while file_bytes(count, sh_degree) > max_bytes:  # the header contains the count itself
        count -= 1
    return count
