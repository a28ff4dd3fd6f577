"""Writing pictures, as all outputs are written, and saying which."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsmerge.cli.console import say
from gsmerge.errors import SceneError

if TYPE_CHECKING:
    from gsmerge.measure.preview import Picture


def picture_stems(names: Sequence[str]) -> list[str]:
    """A file name without extension for every view, each of its own.

    The image's own name where that tells the views apart, else its path with ``_`` between the folders, else the
    number of the view.

    Args:
        names: Image names as camera files give them, with or without folders and extension.
    """
    from gsmerge.io.photos import IMAGE_SUFFIXES

    paths = []
    for name in names:
        parts = [part for part in re.split(r"[\\/]+", name) if part not in ("", ".", "..")] or ["view"]
        stem, dot, suffix = parts[-1].rpartition(".")
        known = stem and f"{dot}{suffix}".lower() in IMAGE_SUFFIXES
        paths.append([*parts[:-1], stem if known else parts[-1]])
    numbers = [[f"view_{i:03d}"] for i in range(len(names))]
    for candidates in ([path[-1:] for path in paths], paths, numbers):
        stems = ["_".join(path) for path in candidates]
        if len({stem.lower() for stem in stems}) == len(stems):  # some file systems do not tell case apart
            break
    return stems


def png_bytes(picture: Picture) -> bytes:
    """An 8 bit RGB picture as a PNG file."""
    import cv2

    _, data = cv2.imencode(".png", picture[..., ::-1])
    return bytes(data.tobytes())


def write_picture(path: Path, picture: Picture, *, overwrite: bool) -> None:
    """Write an 8 bit RGB picture as PNG, atomically; its folder is made if it is not there.

    Raises:
        SceneError: If the file cannot be written.
    """
    from gsmerge.io import atomic_output

    data = png_bytes(picture)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SceneError(path.parent, f"cannot be made ({error.strerror})", "name another with --output") from error
    with atomic_output(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(data)


def tell_pictures(
    output: Path,
    pictures: Sequence[Path],
    facts: Mapping[str, Any],
    line: str,
    *,
    dry_run: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Say which pictures were written, or would be: as JSON on stdout, or as a line on stderr.

    Args:
        output: What the user asked to be written.
        pictures: The pictures.
        facts: What else the JSON document says.
        line: What they are, in a few words.
        dry_run: Nothing was written.
        as_json: JSON instead of the line.
        quiet: No line.
    """
    from gsmerge.report import document_head, to_json

    if as_json:
        head = {**document_head(), "dry_run": dry_run, "output": str(output)}
        sys.stdout.write(to_json({**head, "pictures": [str(path) for path in pictures], **facts}))
    elif dry_run:
        print(f"would write {output}: {line}")
    else:
        say(f"{output}: {line}", quiet=quiet)
