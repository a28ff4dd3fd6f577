"""Check the inputs and outputs of a command before any work is done."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gsmerge.errors import SceneError, UsageError

if TYPE_CHECKING:
    from gsmerge.reading.scene_files import SceneFiles


def output_file(output: Path, name: str) -> Path:
    """Return the file to write: ``output`` itself or, if it is a folder that exists, the file ``name`` in it.

    Raises UsageError if ``output`` is a format without a name.
    """
    from gsmerge.io.formats.table import OUTPUT_FORMATS

    if output.is_dir():
        return output / name
    ending = f".{output}".lower()
    if ending in (*OUTPUT_FORMATS, ".html") and not output.exists():
        stem = name.partition(".")[0]
        raise UsageError(f"{output}: expected a file to write, found a format; name it as in -o {stem}{ending}")
    return output


def check_outputs(
    outputs: Sequence[Path | None], inputs: Sequence[Path | None], *, overwrite: bool = False, reports: bool = False
) -> None:
    """Raise UsageError for an output that is an input, is given twice, or exists and may not be replaced.

    ``inputs``: files that are read, and folders of photos or cameras, whose photos and camera files are not replaced.
    ``reports``: the outputs are reports. Reports replace reports of gsmerge, and no other files, whatever ``overwrite``
    is. Raises SceneError if an output cannot be written. Missing folders are not made here.
    """
    from gsmerge.io.atomic import describe_existing
    from gsmerge.io.cameras.read_cameras import find_cameras
    from gsmerge.io.first_bytes import may_be_replaced
    from gsmerge.io.image_names import IMAGE_SUFFIXES

    paths = [path for path in inputs if path is not None]
    camera_files = [cameras for path in paths if path.is_dir() and (cameras := find_cameras(path)) is not None]
    input_paths = {os.path.realpath(path) for path in (*paths, *camera_files)}
    seen = set[str]()
    for output in outputs:
        if output is None:
            continue
        try:
            os.lstat(output)
        except FileNotFoundError:
            pass
        except (OSError, ValueError) as error:  # ValueError: the name has a zero byte
            reason = getattr(error, "strerror", None) or error
            raise SceneError(output, f"cannot be written ({reason})", "choose another name") from error
        if output.exists() and not output.is_file():
            raise UsageError(
                f"{output}: expected a file to write, found"
                f" {'a folder; name a file in it' if output.is_dir() else 'a pipe or a device; name a file'}"
            )
        target = Path(os.path.realpath(output))
        is_image = target.suffix.lower() in IMAGE_SUFFIXES and target.exists()
        if str(target) in input_paths or (is_image and str(target.parent) in input_paths):
            raise UsageError(f"{output}: expected an output other than the input; name another output")
        if os.path.lexists(output) and not (overwrite or (reports and may_be_replaced(output))):
            problem = f"{output}: {describe_existing(output)}"
            raise UsageError(
                f"{problem} and is not a report of gsmerge; name another output" if reports
                else f"{problem}; pass --overwrite to replace it, or name another output"
            )  # fmt: skip
        _check_writable(output.parent, output, "a folder to write to")
        if str(target) in seen:
            raise UsageError(f"{output}: expected a different file for each output, got it twice")
        seen.add(str(target))


def _check_writable(folder: Path, output: Path, expected: str) -> None:
    """Raise SceneError for ``output`` if a folder, or the nearest existing folder above it, cannot be written to."""
    try:
        nearest = next(path for path in (folder, *folder.absolute().parents) if os.path.lexists(path))
    except OSError as error:
        raise SceneError(output, f"cannot be read ({error.strerror})", "name another output") from error
    except StopIteration:  # on Windows, if the drive does not exist
        raise SceneError(output, f"found no drive {folder.absolute().drive}", "name another output") from None
    if not nearest.is_dir():
        raise SceneError(output, f"expected {expected}, found the file {nearest}", "name another output")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise SceneError(output, f"cannot be written: no permission for {nearest}", "name another output")


def input_files(files: SceneFiles) -> tuple[Path, ...]:
    """List the files of Gaussians and cameras, and the folders of photos, that are read for a scene."""
    return (*files.paths, *(path for scene_files in files.more for path in input_files(scene_files)))


def write_texts(texts: Mapping[Path, str | bytes], mode: int = 0o666) -> None:
    """Write texts to files, either all or none; existing files are replaced.

    ``mode``: permissions of new files, of which the user's mask may take some away.
    """
    from gsmerge.io import atomic_outputs

    with atomic_outputs(overwrite=True, mode=mode) as add:
        for path, text in texts.items():
            add(path).write_bytes(text if isinstance(text, bytes) else text.encode(errors="replace"))


def check_folder(folder: Path, inputs: tuple[Path, ...], *, overwrite: bool) -> None:
    """Raise UsageError for an output folder that is an input, or that has files without ``overwrite``.

    Raises SceneError if the folder cannot be written to. A missing folder is not made here.
    """
    _check_writable(folder, folder, "a folder to write pictures to")
    try:
        occupied = folder.is_dir() and next(folder.iterdir(), None) is not None
    except OSError as error:
        raise SceneError(folder, f"cannot be read ({error.strerror})", "name another output") from error
    if any(os.path.realpath(folder) == os.path.realpath(path) for path in inputs):
        raise UsageError(f"{folder}: expected an output other than the input; name another folder")
    if occupied and not overwrite:
        raise UsageError(f"{folder}: expected an empty folder; pass --overwrite to write into it")
