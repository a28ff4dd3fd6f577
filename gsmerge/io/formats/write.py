"""Writers of Gaussians, by the format that a file's name asks for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gsmerge.io.atomic import atomic_output
from gsmerge.io.formats import ply
from gsmerge.io.formats.table import COLMAP, PLY, output_format
from gsmerge.types import Gaussians, StrPath

NamedPhotos = Sequence[tuple[str, Path | None]]  # names below a model's folder of photos, and files if known


def lost_harmonics(path: StrPath, sh_degree: int) -> str | None:
    """Describe the harmonics that a format leaves out; None if it keeps all. UsageError for an unknown ending."""
    chosen = output_format(path, levels=True, cameras=True)
    if sh_degree <= chosen.max_degree:
        return None
    if chosen is COLMAP:
        return "points of COLMAP have colours alone: harmonics, sizes and opacities are left out"
    if chosen is PLY:
        return f"harmonics above degree {chosen.max_degree} are left out: few programs read a .ply with them"
    return f"{chosen.ending} has no room for harmonics above degree {chosen.max_degree}: left out"


def photo_folder(points: Path) -> Path:
    """Return the folder in which trainers look for the photos of a COLMAP model, given the path of its points."""
    return points.parent.parent.parent / "images"


def output_notes(out: Path, sh_degree: int, photos: NamedPhotos) -> list[str]:
    """Describe what an output lacks: harmonics that are not written, and the ``photos`` of a COLMAP model."""
    lost, place = lost_harmonics(out, sh_degree), photo_folder(out)
    notes = [lost] if lost else []
    if COLMAP.names(out) and (place.exists() or any(photo is None for _, photo in photos)):
        absent = len({name for name, _ in photos if not (place / name).is_file()})
        more = f"trainers look for photos in {place}: copy or link the {absent:,} that it lacks there"
        notes += [more] if absent else []
    return notes


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

    All but ``.ply`` and USD quantise. ``.glb`` and USD have y upward, so Gaussians are turned by half a turn about z in
    them. Harmonics of degree 4 are left out, except by :func:`write_ply`.

    Args:
        path: The file; complete or not there at all.
        gaussians: Finite values.
        overwrite: Replace an existing file.
        comments: Lines for the header of the two that have one; ``.spz`` and ``.sog`` keep "SplatRenderMode: mip".
        ending: Format to write instead of the name's.
        normals: Of a ``.ply``, as in :func:`write_ply`.

    Raises:
        UsageError: If the name ends in none of these, or ``usd-core`` is needed and not installed.
        SceneError: If the file exists or cannot be written.
        ValueError: If there is no Gaussian, NaN or inf, a comment is no line of ASCII, or there are half a million
            characters of them.

    Example:
        >>> gaussians = gsmerge.compact("demo", effort="draft", budget=300).gaussians
        >>> gsmerge.write_gaussians("demo/small.splat", gaussians, overwrite=True)
    """
    chosen = output_format(ending or path)
    if chosen.encode is None:
        degree = min(gaussians.sh_degree, chosen.max_degree)
        write_ply(path, gaussians, overwrite=overwrite, sh_degree=degree, comments=comments, normals=normals)
        return
    check_readable(gaussians, comments)
    with atomic_output(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(chosen.encode(gaussians, comments))


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
    check_readable(gaussians, comments)
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    if not 0 <= degree <= gaussians.sh_degree:
        raise ValueError(f"sh_degree: expected 0 to {gaussians.sh_degree}, got {sh_degree}")
    with atomic_output(path, overwrite=overwrite) as temporary, temporary.open("wb") as file:
        file.writelines(ply.ply_blocks(gaussians, degree, comments, normals=normals))


def check_readable(gaussians: Gaussians, comments: Sequence[str]) -> None:
    """Raise ValueError for what the readers refuse."""
    if len(gaussians) == 0:
        raise ValueError("gaussians: expected at least one, got none")
    length = sum(len(f"comment {comment}\n") for comment in comments)
    if length > ply.MAX_HEADER_BYTES // 2:
        raise ValueError(f"comments: expected at most {ply.MAX_HEADER_BYTES // 2:,} characters, got {length:,}")
    if not all(comment.isascii() and comment.isprintable() for comment in comments):
        raise ValueError(f"comments: expected printable lines of ASCII, got {list(comments)}")
