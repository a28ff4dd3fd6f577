"""Where a command reads from and writes to, checked before any work is done."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gsmerge.errors import SceneError, UsageError

if TYPE_CHECKING:
    from gsmerge.io import CameraFile, SceneFiles


def default_output(ply: Path) -> Path:
    """``scene.ply`` -> ``scene.compact.ply`` beside it."""
    return ply.with_name(f"{ply.stem}.compact.ply")


def check_output(output: Path, inputs: tuple[Path, ...], *, overwrite: bool) -> None:
    """Refuse an output file that is one of the inputs, that exists, or whose folder does not.

    Raises:
        UsageError: If the output is an input, or exists and ``overwrite`` is False.
        SceneError: If the output cannot be written.
    """
    if any(output.resolve() == path.resolve() for path in inputs):
        raise UsageError(f"{output}: expected an output other than the input; name another file with --output")
    if output.is_dir():
        raise UsageError(f"{output}: expected a file to write, found a folder; name a file in it")
    if output.exists() and not overwrite:
        raise UsageError(f"{output}: exists already; pass --overwrite to replace it, or name another with --output")
    if not output.parent.is_dir():
        raise SceneError(output, f"expected a folder to write to, found no {output.parent}", "make it first")


def check_folder(folder: Path, *, overwrite: bool) -> None:
    """Make an output folder; refuse one that holds files unless ``overwrite``.

    Raises:
        UsageError: If the folder holds files and ``overwrite`` is False.
        SceneError: If it cannot be made or is a file.
    """
    if folder.exists() and not folder.is_dir():
        raise SceneError(folder, "expected a folder to write pictures to, found a file", "name another with --output")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        occupied = next(folder.iterdir(), None) is not None
    except OSError as error:
        raise SceneError(folder, f"cannot be written ({error.strerror})", "name another with --output") from error
    if occupied and not overwrite:
        raise UsageError(f"{folder}: expected an empty folder; pass --overwrite to write into it")


def cameras_of(files: SceneFiles) -> CameraFile:
    """The cameras found with a scene.

    Raises:
        SceneError: If none were found, or they cannot be read.
    """
    from gsmerge.io import read_cameras

    if files.cameras is None:
        raise SceneError(files.ply, "no cameras found beside it", "name them with --cameras")
    return read_cameras(files.cameras)
