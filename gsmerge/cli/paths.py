"""Check where a command reads from and writes to, before any work is done."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from gsmerge.errors import SceneError, UsageError
from gsmerge.settings.setting import Settings, setting

if TYPE_CHECKING:
    from gsmerge.scene.files import SceneFiles


# In the first bytes of what gsmerge makes for readers: pages, JSON, CSV, Markdown
MARKS = (b'content="gsmerge ', b'"name": "gsmerge"', b"schema_version,result,", b"<!-- gsmerge ")
MARKED = 4000  # of these bytes


@dataclass(frozen=True)
class FileOptions(Settings):
    """Options for writing a result."""

    normals: bool = setting(True, "Write the three columns of zeros that some viewers want of a `.ply`, 12 of its 68 "
        "bytes per Gaussian; a `budget` in bytes counts them.")  # fmt: skip
    columns: str = setting("needed", "Columns of a `.ply`: those that are needed, or full: all 62 of INRIA's, which "
        "Unity's importer wants, with zeros for harmonics up to degree 3.", choices=("needed", "full"))  # fmt: skip
    site: bool = setting(False, "Write a web site into the folder `-o`: a page as of `.html`, with its scene and "
        "viewer beside it.")  # fmt: skip
    viewer_cameras: bool = setting(True, "Write the input views beside the result of `compact`, as `NAME.cameras.json` "
        "for viewers.")  # fmt: skip


def default_output(ply: Path) -> Path:
    """Return the default path of a result: ``scene.ply`` -> ``scene.compact.ply`` beside it."""
    return ply.with_name(f"{ply.stem}.compact.ply")


def output_file(output: Path, name: str, *, site: bool = False) -> Path:
    """Return the file that an output names: itself, or of a folder, which a new name without an ending is, its file.

    That is the page of a ``site``, the main file of the format that the folder's name means, and otherwise ``name``.
    """
    from gsmerge.io.formats.table import FOLDERS, FORMATS, OUTPUT_FORMATS

    if site:
        page = next(row for row in FORMATS if row.site)
        if output.suffix.lower() in OUTPUT_FORMATS:
            raise UsageError(f"site: expected a folder to write into, got {output}")
        return output if page.names(output) else output / page.site
    if output.name in FOLDERS:
        return output / FOLDERS[output.name].place / FOLDERS[output.name].ending
    is_folder = output.is_dir() or not (output.suffix or os.path.lexists(output))
    return output / name if is_folder else output


def is_page(path: Path) -> bool:
    """Return whether a file is a page, or a table, that gsmerge made."""
    return any(mark in _start_of(path) for mark in MARKS)


def _start_of(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(MARKED)
    except OSError:  # there is none yet, or writing fails with its own reason
        return b""


def files_beside(output: Path, *, site: bool = False) -> tuple[Path, ...]:
    """List the other files of an output whose names are known; SceneError if another program's are there."""
    from gsmerge.io.formats.table import find_format

    return tuple(find_format(output).beside(output, site))


def check_format(output: Path, options: FileOptions) -> None:
    """Raise UsageError if an output's ending is unknown, its package is missing, or it does not fit the options."""
    from gsmerge.io import output_format

    columns = output_format(output, levels=True, cameras=True).columns
    if options.columns == "full" and not (columns and options.normals):
        raise UsageError(f"columns full: expected an output as .ply, with normals, got {output.name}")


def check_outputs(outputs: Sequence[Path | None], inputs: Sequence[Path | None], *, overwrite: bool) -> None:
    """Raise UsageError for an output that is an input, exists without ``overwrite``, or is given twice.

    ``inputs`` are files that are read, and folders of photos and COLMAP models; nothing in these is replaced.
    SceneError if the output cannot be written. Missing folders are made with the first file in them, so a run that
    fails before leaves no folders.
    """
    from gsmerge.io.cameras.read import find_cameras

    paths = [path for path in inputs if path is not None]
    inside = [cameras for path in paths if path.is_dir() and (cameras := find_cameras(path)) is not None]
    input_paths, seen = {os.path.realpath(path) for path in (*paths, *inside)}, set[str]()
    for output in outputs:
        if output is None:
            continue
        _check_output(output, input_paths, overwrite=overwrite)
        if os.path.realpath(output) in seen:
            raise UsageError(f"{output}: expected a file of its own for each output, got it twice")
        seen.add(os.path.realpath(output))


def _check_output(output: Path, inputs: set[str], *, overwrite: bool) -> None:
    from gsmerge.io.atomic import check_name
    from gsmerge.io.formats.table import MODEL_NAMES
    from gsmerge.io.image_names import IMAGE_SUFFIXES

    check_name(output)
    try:
        os.lstat(output)
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:  # the latter: a zero byte
        reason = getattr(error, "strerror", None) or error
        raise SceneError(output, f"cannot be written ({reason})", "choose another name") from error
    if output.is_dir():
        raise UsageError(f"{output}: expected a file to write, found a folder; name a file in it")
    target = Path(os.path.realpath(output))
    is_read = (target.suffix.lower() in IMAGE_SUFFIXES or target.name in MODEL_NAMES) and target.exists()
    if str(target) in inputs or (is_read and str(target.parent) in inputs):
        raise UsageError(f"{output}: expected an output other than the input; name another output")
    if os.path.lexists(output) and not overwrite:
        raise UsageError(f"{output}: exists already; pass --overwrite to replace it, or name another output")
    _check_place(output.parent, output, "a folder to write to")


def check_replaced(outputs: Sequence[Path]) -> None:
    """Raise UsageError for an output that exists, unless it is a page or a table that gsmerge made."""
    for output in outputs:
        if _start_of(output) and not is_page(output):
            raise UsageError(f"{output}: exists already, and is no report that gsmerge made; name another output")


def _check_place(folder: Path, output: Path, expected: str) -> None:
    """Raise SceneError if a folder, or the nearest one above it that exists, cannot be written to."""
    try:
        nearest = next(path for path in (folder, *folder.absolute().parents) if os.path.lexists(path))
    except OSError as error:
        raise SceneError(output, f"cannot be read ({error.strerror})", "name another output") from error
    except StopIteration:  # of a Windows that has no such drive
        raise SceneError(output, f"found no drive {folder.absolute().drive}", "name another output") from None
    if not nearest.is_dir():
        raise SceneError(output, f"expected {expected}, found the file {nearest}", "name another output")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise SceneError(output, f"cannot be written: no permission for {nearest}", "name another output")


def input_files(files: SceneFiles) -> tuple[Path, ...]:
    """List the files of Gaussians, cameras and photos that reading the scene uses."""
    return (*files.paths, *(path for scene_files in files.more for path in input_files(scene_files)))


def write_texts(texts: Mapping[Path, str], *, overwrite: bool) -> None:
    """Write text files: all of them, or none."""
    from gsmerge.io import atomic_outputs

    with atomic_outputs(overwrite=overwrite) as add:
        for path, text in texts.items():
            add(path).write_bytes(text.encode(errors="replace"))


def check_folder(folder: Path, inputs: tuple[Path, ...], *, overwrite: bool) -> None:
    """Raise UsageError for an output folder with files (unless ``overwrite``) or photos, or without write access.

    The folder is made with the first file in it, so a run that fails before leaves no folder.
    """
    _check_place(folder, folder, "a folder to write pictures to")
    try:
        occupied = folder.is_dir() and next(folder.iterdir(), None) is not None
    except OSError as error:
        raise SceneError(folder, f"cannot be read ({error.strerror})", "name another output") from error
    if any(os.path.realpath(folder) == os.path.realpath(path) for path in inputs):
        raise UsageError(f"{folder}: expected an output other than the input; name another folder")
    if occupied and not overwrite:
        raise UsageError(f"{folder}: expected an empty folder; pass --overwrite to write into it")
