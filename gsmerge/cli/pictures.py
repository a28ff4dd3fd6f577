"""Names of pictures, writing them, and saying which were written."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsmerge.cli.console import print_document, say
from gsmerge.cli.options import Args
from gsmerge.errors import SceneError

if TYPE_CHECKING:
    from gsmerge.measure.preview import Picture


def picture_stems(names: Sequence[str]) -> list[str]:
    """A file name without extension for every view, each of its own.

    The image's own name where that tells the views apart, else its path with ``_`` between the folders, else the
    number of the view.
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
    """Write an 8 bit RGB picture as PNG, atomically; its folder is made if it is not there."""
    from gsmerge.io import atomic_output

    data = png_bytes(picture)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SceneError(path.parent, f"cannot be made ({error.strerror})", "name another with --output") from error
    with atomic_output(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(data)


def report_pictures(args: Args, pictures: Sequence[Path], facts: Mapping[str, Any], line: str) -> None:
    """Say which pictures were written, or would be: as JSON with further ``facts``, or as a line."""
    from gsmerge.report import document_head

    if args.json or args.dry_run:
        head = {**document_head(), "dry_run": args.dry_run, "output": str(args.output)}
        document = {**head, "pictures": [str(path) for path in pictures], **facts}
        print_document(document, f"would write {args.output}: {line}", as_json=args.json)
    else:
        say(f"{args.output}: {line}", quiet=args.quiet)
