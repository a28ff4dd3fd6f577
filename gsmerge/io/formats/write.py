"""Writers of Gaussians, by the format that a file's name asks for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gsmerge.errors import UsageError
from gsmerge.io.atomic import AddOutput, atomic_output, atomic_outputs
from gsmerge.io.formats import ply, sog, streamed
from gsmerge.io.formats.arrays import MIP_COMMENT
from gsmerge.io.formats.table import COLMAP, PLY, output_format
from gsmerge.types import Gaussians, StrPath


def lost_harmonics(path: StrPath, sh_degree: int, spz_version: int = 3) -> str | None:
    """Describe the harmonics that a format leaves out; None if it keeps all. UsageError for an unknown ending."""
    chosen = output_format(path, spz_version, levels=True, cameras=True)
    if sh_degree <= chosen.max_degree:
        return None
    if chosen is COLMAP:
        return "points of COLMAP have colours alone: harmonics, sizes and opacities are left out"
    if chosen is PLY:
        return f"harmonics above degree {chosen.max_degree} are left out: few programs read a .ply with them"
    return f"{chosen.ending} has no room for harmonics above degree {chosen.max_degree}: left out"


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
    """Write Gaussians to a file; the ending of its name, one of ``OUTPUT_FORMATS``, chooses the format.

    All but ``.ply`` and USD quantise. ``.glb`` and USD have y upward, so Gaussians are turned by half a turn about z in
    them. Harmonics of degree 4 are left out, except in a ``.spz`` of version 4 and by :func:`write_ply`.

    Args:
        path: The file; complete or not there at all.
        gaussians: Finite values.
        overwrite: Replace an existing file.
        comments: Lines for the header of the two that have one; ``.spz`` and ``.sog`` keep "SplatRenderMode: mip".
        ending: Format to write instead of the name's.
        normals: Of a ``.ply``, as in :func:`write_ply`.
        spz_version: Of a ``.spz``: 3, which most programs read, or 4, which has room for harmonics of degree 4 and
            needs ``zstandard``.

    Raises:
        UsageError: If the name ends in none of these, or ``zstandard`` or ``usd-core`` is needed and not installed.
        SceneError: If the file exists or cannot be written.
        ValueError: If there is no Gaussian, NaN or inf, a comment is no line of ASCII, or there are half a million
            characters of them, or there is no such version.

    Example:
        >>> gaussians = gsmerge.compact("demo", effort="draft", budget=300).gaussians
        >>> gsmerge.write_gaussians("demo/small.splat", gaussians, overwrite=True)
    """
    chosen = output_format(ending or path, spz_version)
    if chosen.encode is None:
        degree = min(gaussians.sh_degree, chosen.max_degree)
        write_ply(path, gaussians, overwrite=overwrite, sh_degree=degree, comments=comments, normals=normals)
        return
    _check_readable(gaussians, comments)
    with atomic_output(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(chosen.encode(gaussians, comments))


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
        comments: Lines as in :func:`write_gaussians`; only "SplatRenderMode: mip" is kept.

    Raises:
        UsageError: If the name is another one.
        SceneError: If the file exists or cannot be written.
        ValueError: If there is NaN or inf, no Gaussian at some level, or a comment is no line of ASCII.

    Example:
        >>> result = gsmerge.compact("demo", effort="draft", budget=300, levels=2)
        >>> levels = [result.gaussians, *(level.gaussians for level in result.coarser)]
        >>> gsmerge.write_levels("demo/web/lod-meta.json", levels, overwrite=True)
    """
    path = Path(path)
    if path.name != streamed.INDEX:
        raise UsageError(f"{path}: expected the name {streamed.INDEX}, by which viewers recognise the format")
    with atomic_outputs(overwrite=overwrite) as add:
        add_levels(add, path, add(path), levels, comments)
    streamed.remove_unused_chunks(path)


def add_levels(
    add: AddOutput,
    path: Path,
    index: Path,
    levels: Sequence[Gaussians],
    comments: Sequence[str] = (),
    *,
    environment: Gaussians | None = None,
    measure: streamed.LeafErrors | None = None,
) -> list[tuple[Path, list[Path]]]:
    """Write the files of a Streamed SOG as part of :func:`atomic_outputs`; ``index`` is the temporary file of ``path``.

    For ``environment`` and ``measure`` see :func:`streamed.streamed_files`. Returns for each level the final path of
    the ``meta.json`` of its first chunk, and the temporary paths of all its files. The files of an environment belong
    to the finest level.
    """
    for gaussians in levels if environment is None else (*levels, environment):
        _check_readable(gaussians, comments)
    firsts: dict[str, Path] = {}
    written: dict[str, list[Path]] = {}
    mip = MIP_COMMENT in comments
    for name, data in streamed.streamed_files(levels, mip=mip, environment=environment, measure=measure).items():
        if name == streamed.INDEX:
            index.write_bytes(data)
            continue
        target, level = path.parent / name, "0" if name.startswith(streamed.ENVIRONMENT) else name.partition("_")[0]
        same = target.is_file() and target.read_bytes() == data  # its name has a hash of its content
        written.setdefault(level, []).append(target if same else add(target))
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
        ValueError: If there is no Gaussian, NaN or inf, fewer harmonics than asked for, a comment is no line of ASCII,
            or there are half a million characters of them.

    Example:
        >>> result = gsmerge.compact("demo", effort="draft", budget=300)
        >>> gsmerge.write_ply("demo/small.ply", result.gaussians, overwrite=True)
    """
    _check_readable(gaussians, comments)
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    if not 0 <= degree <= gaussians.sh_degree:
        raise ValueError(f"sh_degree: expected 0 to {gaussians.sh_degree}, got {sh_degree}")
    with atomic_output(path, overwrite=overwrite) as temporary, temporary.open("wb") as file:
        file.writelines(ply.ply_blocks(gaussians, degree, comments, normals=normals))


def _check_readable(gaussians: Gaussians, comments: Sequence[str]) -> None:
    """Raise ValueError for Gaussians or comments that the readers would refuse."""
    if len(gaussians) == 0:
        raise ValueError("gaussians: expected at least one, got none")
    length = sum(len(f"comment {comment}\n") for comment in comments)
    if length > ply.MAX_HEADER_BYTES // 2:
        raise ValueError(f"comments: expected at most {ply.MAX_HEADER_BYTES // 2:,} characters, got {length:,}")
    if not all(comment.isascii() and comment.isprintable() for comment in comments):
        raise ValueError(f"comments: expected printable lines of ASCII, got {list(comments)}")
